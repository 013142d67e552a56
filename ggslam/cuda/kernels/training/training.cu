// SPDX-License-Identifier: Apache-2.0
// The C interface of training. Only starts work on the caller's stream. Functions return 0 or a cudaError_t.
#include "training/training_kernels.cuh"

#include <algorithm>

#include "common/host.cuh"
#include "rendering/count_pairs.cuh"

namespace ggslam::cuda {
namespace {

cudaStream_t stream_of(const TrainingJob& job) { return static_cast<cudaStream_t>(job.rendering.stream); }

TrainingDesk* desk_of(const TrainingJob& job) { return static_cast<TrainingDesk*>(job.desk); }

// The job with what each step finds on the desk.
TrainingJob at_desk(const TrainingJob& given) {
  TrainingJob job = given;
  TrainingDesk* desk = desk_of(job);
  job.rendering.pose = desk->pose;
  job.rendering.most_pairs = desk->totals + 1;
  job.adam.current_rates = desk->step.rates;
  job.loss.target = &desk->step.images;
  if (job.loss.exposure != nullptr) job.loss.exposure = desk->exposure;
  job.keyframe.choice = &desk->step.keyframe;
  job.loss.stream = job.keyframe.stream = job.rendering.stream;
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

// A step of identity learning on a training step's rendering.
struct Lesson {
  const IdentityJob* job;
  const IdentityStep* step;
};

// The step that is next on the desk. All that is started is the same for every step, but for `bounded` and the lesson,
// and nothing of it waits, allocates or copies to the host: it could be recorded as a graph.
int make_step(const TrainingJob& job, bool bounded, const Lesson& lesson) {
  const CaptureRegion region;
  launch(begin_step_kernel, 1, kWarp, stream_of(job), desk_of(job));
  int status = ggslam_cuda_project(&job.rendering, nullptr);
  if (status == 0) status = ggslam_cuda_composite(&job.rendering);
  if (status == 0) status = ggslam_cuda_image_loss(&job.loss);
  if (status == 0 && lesson.step != nullptr) status = ggslam_cuda_learn(lesson.job, lesson.step, &job.rendering);
  if (status == 0)
    status = ggslam_cuda_backward(&job.rendering, &job.image_gradients, &job.gradients, &job.adam, job.row_memory);
  if (status == 0) status = ggslam_cuda_keyframe_step(&job.keyframe);
  if (status == 0 && bounded) bound_values(job);
  return status;
}

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

GGSLAM_EXPORT int ggslam_cuda_train(const TrainingJob* given, const TrainingStep* steps, int count,
                                    const IdentityJob* identity, const IdentityStep* lessons, void* counter,
                                    std::int64_t* recent_pairs) {
  const TrainingJob job = at_desk(*given);
  return on_device(job.rendering.device, [&] {
    int status = 0;
    for (int i = 0; i < count && status == 0; ++i) {
      if (i % kMostWaitingSteps == 0)
        lay_down_steps(job, steps + i, std::min(count - i, kMostWaitingSteps), i == 0);
      const Lesson lesson{identity, steps[i].lesson >= 0 ? lessons + steps[i].lesson : nullptr};
      status = make_step(job, steps[i].bounded != 0, lesson);
    }
    if (count > 0) count_pairs(counter, desk_of(job)->totals, stream_of(job));
    *recent_pairs = ggslam_cuda_recent_pairs(counter);
    return static_cast<cudaError_t>(status);
  });
}
