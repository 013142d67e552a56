// SPDX-License-Identifier: Apache-2.0
// The C interface of training. Only starts work on the caller's stream. Functions return 0 or a cudaError_t.
#include "training/training_kernels.cuh"

#include <algorithm>

#include "common/host.cuh"
#include "rendering/count_pairs.cuh"
#include "training/step_graphs.cuh"

namespace ggslam::cuda {
namespace {

cudaStream_t stream_of(const TrainingJob& job) { return static_cast<cudaStream_t>(job.rendering.stream); }

TrainingDesk* desk_of(const TrainingJob& job) { return static_cast<TrainingDesk*>(job.desk); }

// The job with what each step finds on the desk, to be started on a stream.
TrainingJob at_desk(const TrainingJob& given, cudaStream_t stream) {
  TrainingJob job = given;
  TrainingDesk* desk = desk_of(job);
  job.rendering.pose = desk->pose;
  job.rendering.most_pairs = desk->totals + 1;
  job.adam.current_rates = desk->step.rates;
  job.loss.target = &desk->step.images;
  if (job.loss.exposure != nullptr) job.loss.exposure = desk->exposure;
  job.keyframe.choice = &desk->step.keyframe;
  job.rendering.stream = job.loss.stream = job.keyframe.stream = stream;
  job.loss.device = job.keyframe.device = job.rendering.device;
  return job;
}

void bound_values(const TrainingJob& job) {
  const GaussianArrays& arrays = job.rendering.gaussians;
  const std::int64_t sizes = 3 * arrays.count, colors = sizes * arrays.sh_coefficients;
  launch(bound_sizes_kernel, blocks_for(sizes, kBoundThreads), kBoundThreads, stream_of(job),
         job.adam.log_scales.parameters, sizes, job.largest_log_scale);
  if (job.bounds_colors != 0)
    launch(bound_colors_kernel, blocks_for(colors, kBoundThreads), kBoundThreads, stream_of(job),
           job.adam.sh.parameters, colors, job.darkest, job.brightest);
}

// The step that is next on the desk, up to its loss. All that is started is the same for every step, and nothing of it
// waits, allocates or copies to the host: it can be recorded as a graph.
int start_forward(const TrainingJob& job) {
  launch(begin_step_kernel, 1, kWarp, stream_of(job), desk_of(job));
  int status = ggslam_cuda_project(&job.rendering, nullptr);
  if (status == 0) status = ggslam_cuda_composite(&job.rendering);
  if (status == 0) status = ggslam_cuda_image_loss(&job.loss);
  return status;
}

// What follows from the loss, likewise.
int start_backward(const TrainingJob& job, bool bounded) {
  int status =
      ggslam_cuda_backward(&job.rendering, &job.image_gradients, &job.gradients, &job.adam, job.row_memory);
  if (status == 0) status = ggslam_cuda_keyframe_step(&job.keyframe);
  if (status == 0 && bounded) bound_values(job);
  return status;
}

// Steps of a job, by graphs if there are any.
class StepRun {
 public:
  StepRun(const TrainingJob& given, StepGraphs* graphs)
      : given_(given), stream_(stream_of(given)), job_(at_desk(given, stream_)), graphs_(graphs) {
    if (graphs_ != nullptr) graphs_->choose(given);
  }

  const TrainingJob& job() const { return job_; }

  int make(bool bounded) const {
    return run(bounded ? kWholeBoundedStep : kWholeStep, [bounded](const TrainingJob& job) {
      const int status = start_forward(job);
      return status != 0 ? status : start_backward(job, bounded);
    });
  }

  // With a step of identity learning on the same rendering.
  int make(bool bounded, const IdentityJob* identity, const IdentityStep* lesson) const {
    int status = run(kBeforeLesson, start_forward);
    if (status == 0) status = ggslam_cuda_learn(identity, lesson, &job_.rendering);
    if (status != 0) return status;
    return run(bounded ? kAfterLessonBounded : kAfterLesson,
               [bounded](const TrainingJob& job) { return start_backward(job, bounded); });
  }

 private:
  template <class Start>
  int run(StepPiece piece, const Start& start) const {
    if (graphs_ == nullptr) {
      const CaptureRegion region;
      return start(job_);
    }
    return graphs_->run(piece, stream_, [&](cudaStream_t stream) { return start(at_desk(given_, stream)); });
  }

  const TrainingJob& given_;
  cudaStream_t stream_;
  TrainingJob job_;
  StepGraphs* graphs_;
};

void lay_down_steps(const TrainingJob& job, const TrainingStep* steps, int count, bool first) {
  StepBatch batch = {};
  std::copy_n(steps, count, batch.steps);
  batch.count = count;
  batch.first = first ? 1 : 0;
  launch(lay_down_steps_kernel, 1, kWarp, stream_of(job), batch, desk_of(job));
}

}  // namespace
}  // namespace ggslam::cuda

using namespace ggslam::cuda;

GGSLAM_EXPORT std::int64_t ggslam_cuda_training_bytes() { return sizeof(TrainingDesk); }

GGSLAM_EXPORT int ggslam_cuda_graphs_create(int device, void** graphs) {
  auto* made = new StepGraphs(device);
  *graphs = made;
  return on_device(device, [&] { return made->begin(); });
}

GGSLAM_EXPORT void ggslam_cuda_graphs_destroy(void* graphs) {
  auto* made = static_cast<StepGraphs*>(graphs);
  on_device(made->device(), [&] {
    delete made;
    return cudaSuccess;
  });
}

GGSLAM_EXPORT void ggslam_cuda_graph_counts(const void* graphs, GraphCounts* counts) {
  *counts = static_cast<const StepGraphs*>(graphs)->counts();
}

GGSLAM_EXPORT int ggslam_cuda_train(const TrainingJob* given, const TrainingStep* steps, int count,
                                    const IdentityJob* identity, const IdentityStep* lessons, void* graphs,
                                    void* counter, std::int64_t* recent_pairs) {
  return on_device(given->rendering.device, [&] {
    const StepRun run(*given, static_cast<StepGraphs*>(graphs));
    const TrainingJob& job = run.job();
    int status = 0;
    for (int i = 0; i < count && status == 0; ++i) {
      if (i % kMostWaitingSteps == 0)
        lay_down_steps(job, steps + i, std::min(count - i, kMostWaitingSteps), i == 0);
      const bool bounded = steps[i].bounded != 0;
      status = steps[i].lesson < 0 ? run.make(bounded) : run.make(bounded, identity, lessons + steps[i].lesson);
    }
    if (count > 0) count_pairs(counter, desk_of(job)->totals, stream_of(job));
    *recent_pairs = ggslam_cuda_recent_pairs(counter);
    return static_cast<cudaError_t>(status);
  });
}
