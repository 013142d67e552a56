// SPDX-License-Identifier: Apache-2.0
// One step of identity learning: pixels are drawn, what shows there votes and is taught, the classifier follows. Only
// starts work on the caller's stream. Functions return 0 or a cudaError_t.
#include "mapping/identity_kernels.cuh"

#include <algorithm>

#include "common/carver.cuh"
#include "common/host.cuh"

namespace ggslam::cuda {
namespace {

struct IdentityWorkspace {
  std::int32_t *labels, *classes, *shown;  // [P], pixels
  float* shares;                           // [P]
  std::int32_t *term_gaussians, *term_counts;  // [P + R, capacity] and [P + R]; R: rows that are pulled together
  float* term_weights;                     // [P + R, capacity]
  float *features, *logits;                // [P, channels], [P, classes]
  float *gradients, *row_gradients;        // [P + R, channels], [classes, channels + 1]
  std::int64_t *rows, *neighbours;         // [S] and [S, k], samples of the pull
  std::int32_t* pulled;                    // [R], both
  float *pulled_logits, *pulled_gradients; // [R, classes]
  std::uint32_t *sorted_gaussians, *sorted_places;  // [(P + R) * capacity]
  void *sorting, *searching, *drawing;
  std::size_t bytes;
};

std::int64_t pulled_rows(const IdentityJob& job) {
  return static_cast<std::int64_t>(job.samples) * (1 + job.neighbours);
}

NeighbourJob neighbour_job(const IdentityJob& job) {
  NeighbourJob search = {};
  search.points = job.means;
  search.point_count = static_cast<std::int32_t>(job.gaussians);
  search.row_count = job.samples;
  search.k = job.neighbours;
  return search;
}

PixelPoolJob pool_job(const IdentityJob& job, int height, int width) {
  PixelPoolJob pool = {};
  pool.alias = job.alias;
  pool.balance = job.balance, pool.boundary = job.boundary;
  pool.seed = job.seed;
  pool.height = height, pool.width = width;
  return pool;
}

IdentityWorkspace identity_workspace(void* block, const IdentityJob& job, int height, int width) {
  const std::int64_t pixels = job.pixels, all = pixels + pulled_rows(job), entries = all * job.capacity;
  const NeighbourJob search = neighbour_job(job);
  const PixelPoolJob pool = pool_job(job, height, width);
  Carver carver(block);
  IdentityWorkspace w;
  for (std::int32_t** part : {&w.labels, &w.classes, &w.shown}) *part = carver.take<std::int32_t>(pixels);
  w.shares = carver.take<float>(pixels);
  w.term_gaussians = carver.take<std::int32_t>(entries);
  w.term_counts = carver.take<std::int32_t>(all);
  w.term_weights = carver.take<float>(entries);
  w.features = carver.take<float>(pixels * job.channels);
  w.logits = carver.take<float>(pixels * job.classes);
  w.gradients = carver.take<float>(all * job.channels);
  w.row_gradients = carver.take<float>(static_cast<std::int64_t>(job.classes) * (job.channels + 1));
  w.rows = carver.take<std::int64_t>(job.samples);
  w.neighbours = carver.take<std::int64_t>(pulled_rows(job));
  w.pulled = carver.take<std::int32_t>(pulled_rows(job));
  for (float** part : {&w.pulled_logits, &w.pulled_gradients}) *part = carver.take<float>(pulled_rows(job) * job.classes);
  for (std::uint32_t** part : {&w.sorted_gaussians, &w.sorted_places}) *part = carver.take<std::uint32_t>(entries);
  w.sorting = carver.take<char>(ggslam_cuda_terms_sorting_bytes(entries));
  w.searching = carver.take<char>(job.neighbours > 0 ? ggslam_cuda_neighbours_bytes(&search) : 0);
  w.drawing = carver.take<char>(ggslam_cuda_pixel_pool_bytes(&pool));
  w.bytes = carver.used();
  return w;
}

// One step on its way. What goes wrong first is remembered; what is started after it does no harm.
class LessonRun {
 public:
  LessonRun(const IdentityJob& job, const IdentityStep& step, const Rendering& rendering)
      : job_(job),
        step_(step),
        rendering_(rendering),
        w_(identity_workspace(job.workspace, job, rendering.view.height, rendering.view.width)),
        stream_(static_cast<cudaStream_t>(rendering.stream)) {}

  int run() {
    draw();
    look();
    if (job_.trains == 0) {
      vote(job_.pixels);
      return status_;
    }
    compare();
    if (step_.pulls != 0) pull();
    const std::int64_t all = job_.pixels + (step_.pulls != 0 ? pulled_rows(job_) : 0);
    start(drop_terms_kernel, all, job_.known, w_.term_counts, all);
    vote(all);
    follow(all);
    return status_;
  }

 private:
  void note(int status) {
    if (status_ == 0) status_ = status;
  }

  template <class Kernel, class... Arguments>
  void start(Kernel kernel, std::int64_t threads, const Arguments&... arguments) {
    launch(kernel, blocks_for(threads, kIdentityThreads), kIdentityThreads, stream_, arguments...);
  }

  // With the stream and the device of all that is started.
  template <class Job>
  Job started(Job job) const {
    job.stream = rendering_.stream;
    job.device = rendering_.device;
    return job;
  }

  PixelTerms terms(std::int64_t first, std::int64_t count) const {
    const std::int64_t place = first * job_.capacity;
    return {count, w_.term_gaussians + place, w_.term_weights + place, w_.term_counts + first, rendering_.stream,
            job_.capacity, rendering_.device};
  }

  TermsByGaussian by_gaussian(std::int64_t count) const {
    return {w_.sorted_gaussians, w_.sorted_places, count * job_.capacity, job_.gaussians};
  }

  const std::int32_t* pixels() const { return step_.pool + step_.used; }

  void draw() {
    if (step_.drawn == 0) return;
    PixelPoolJob pool = started(pool_job(job_, rendering_.view.height, rendering_.view.width));
    pool.mask = step_.mask;
    pool.pixels = step_.pool, pool.vote_weights = step_.pool_weights;
    pool.workspace = w_.drawing;
    pool.draw = step_.draw, pool.drawn = step_.drawn;
    note(ggslam_cuda_draw_pixels(&pool));
  }

  // Which Gaussians show at the pixels, and which objects the mask has there.
  void look() {
    PixelClassJob labels = started(PixelClassJob{});
    labels.mask = step_.mask, labels.pixels = pixels(), labels.alias = job_.alias;
    labels.labels = w_.labels, labels.count = job_.pixels;
    note(ggslam_cuda_pixel_labels(&labels));
    const PixelTerms seen = terms(0, job_.pixels);
    note(ggslam_cuda_terms_collect(&seen, &rendering_, pixels(), job_.min_weight));
    if (job_.whole_of == nullptr) return;
    note(ggslam_cuda_terms_label(&seen, job_.shown, job_.gaussians, w_.shown, w_.shares));
    start(take_parts_kernel, job_.pixels, w_.shown, job_.whole_of, w_.labels, job_.pixels);
  }

  // What is seen with what the mask says.
  void compare() {
    PixelClassJob classes = started(PixelClassJob{});
    classes.class_of = job_.class_of, classes.labels = w_.labels;
    classes.classes = w_.classes, classes.known = job_.known, classes.count = job_.pixels;
    note(ggslam_cuda_pixel_classes(&classes));
    const PixelTerms seen = terms(0, job_.pixels);
    note(ggslam_cuda_terms_blend(&seen, job_.adam.features.parameters, job_.gaussians, job_.channels, w_.features));
    const std::int64_t pixels = job_.pixels;
    start(logits_kernel, pixels * job_.classes, w_.features, static_cast<const std::int32_t*>(nullptr), pixels,
          job_.rows, job_.classes, w_.logits);
    CrossEntropyJob loss = started(CrossEntropyJob{});
    loss.logits = w_.logits, loss.targets = w_.classes, loss.known = job_.known, loss.losses = job_.losses;
    loss.weight = job_.weight, loss.count = job_.pixels, loss.classes = job_.classes;
    note(ggslam_cuda_cross_entropy(&loss));
    start(vector_gradients_kernel, pixels * job_.channels, w_.logits, pixels, job_.rows, job_.classes, w_.gradients);
    launch(row_gradients_kernel, job_.classes, kIdentityThreads, stream_, w_.logits, w_.features, job_.pixels,
           job_.classes, w_.row_gradients);
  }

  // The 3-D loss: terms and gradients behind those of the pixels.
  void pull() {
    const std::int64_t count = pulled_rows(job_);
    start(draw_rows_kernel, job_.samples, ~job_.seed, step_.pull, job_.gaussians, job_.samples, w_.rows);
    NeighbourJob search = started(neighbour_job(job_));
    search.rows = w_.rows, search.neighbours = w_.neighbours, search.workspace = w_.searching;
    note(ggslam_cuda_neighbours(&search));
    start(list_pulled_kernel, count, w_.rows, w_.neighbours, job_.samples, static_cast<std::int32_t>(count), w_.pulled);
    start(logits_kernel, count * job_.classes, static_cast<const float*>(job_.adam.features.parameters), w_.pulled,
          count, job_.rows, job_.classes, w_.pulled_logits);
    NeighbourLossJob loss = started(NeighbourLossJob{});
    loss.logits = w_.pulled_logits, loss.gradients = w_.pulled_gradients, loss.weight = job_.pull_weight;
    loss.samples = job_.samples, loss.neighbours = job_.neighbours, loss.classes = job_.classes;
    note(ggslam_cuda_neighbour_loss(&loss));
    start(vector_gradients_kernel, count * job_.channels, w_.pulled_gradients, count, job_.rows, job_.classes,
          w_.gradients + static_cast<std::int64_t>(job_.pixels) * job_.channels);
    const PixelTerms single = terms(job_.pixels, count);
    note(ggslam_cuda_terms_of_gaussians(&single, w_.pulled));
  }

  void vote(std::int64_t all) {
    const PixelTerms seen = terms(0, all);
    const TermsByGaussian sorted = by_gaussian(all);
    note(ggslam_cuda_terms_sort(&seen, &sorted, w_.sorting));
    note(ggslam_cuda_terms_vote(&seen, &sorted, w_.labels, step_.pool_weights + step_.used, job_.pixels, job_.vote_ids,
                                job_.vote_weights));
  }

  // Identity vectors and classifier along their gradients.
  void follow(std::int64_t all) {
    const PixelTerms seen = terms(0, all);
    const TermsByGaussian sorted = by_gaussian(all);
    AdamStep adam = job_.adam;
    adam.rates[kFeatures] = static_cast<float>(step_.rate_factor * job_.rate);
    note(ggslam_cuda_terms_step(&seen, &sorted, w_.gradients, job_.channels, &adam));
    ClassAdamJob classes = started(ClassAdamJob{});
    classes.rows = job_.rows;
    classes.first_moments = job_.first_moments, classes.second_moments = job_.second_moments;
    classes.gradients = w_.row_gradients, classes.known = job_.known, classes.steps = job_.steps;
    classes.rate = static_cast<float>(step_.rate_factor * job_.classifier_rate);
    classes.size = static_cast<std::int64_t>(job_.classes) * (job_.channels + 1);
    note(ggslam_cuda_class_adam(&classes));
  }

  const IdentityJob& job_;
  const IdentityStep& step_;
  const Rendering& rendering_;
  IdentityWorkspace w_;
  cudaStream_t stream_;
  int status_ = 0;
};

}  // namespace
}  // namespace ggslam::cuda

using namespace ggslam::cuda;

GGSLAM_EXPORT std::int64_t ggslam_cuda_identity_bytes(const IdentityJob* job, int height, int width) {
  return static_cast<std::int64_t>(identity_workspace(nullptr, *job, height, width).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_learn(const IdentityJob* job, const IdentityStep* step, const Rendering* rendering) {
  return on_device(rendering->device,
                   [&] { return static_cast<cudaError_t>(LessonRun(*job, *step, *rendering).run()); });
}
