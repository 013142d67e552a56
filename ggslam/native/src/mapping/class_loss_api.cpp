// SPDX-License-Identifier: Apache-2.0
// Entry point of the objects' loss. Pixels are handed out in parts whose number does not depend on that of the threads;
// what they add to the classifier's gradient is summed up in their order.
#include "mapping/class_loss.hpp"

#include <algorithm>
#include <limits>
#include <vector>

#include "common/context.hpp"
#include "common/guard.hpp"

namespace ggslam {
namespace {

constexpr std::int64_t kLeastPart = 128, kMostParts = 32;
constexpr float kNever = -1e30f;

// The classifier with its padding, and room for what each part of the pixels adds.
class ClassLoss {
 public:
  explicit ClassLoss(const ClassLossJob& job)
      : classes_(class_loss_padded(job.class_count)), channels_(class_loss_padded(job.channels)),
        part_(std::max(kLeastPart, (job.pixels + kMostParts - 1) / kMostParts)),
        parts_((job.pixels + part_ - 1) / part_), by_channel_(classes_ * channels_, 0.f),
        by_class_(classes_ * channels_, 0.f), biases_(classes_, kNever), sums_(parts_ * classes_ * (channels_ + 1), 0.f),
        losses_(parts_, 0.) {
    for (int k = 0; k < job.class_count; ++k) {
      biases_[k] = job.biases[k];
      for (int f = 0; f < job.channels; ++f)
        by_class_[k * channels_ + f] = by_channel_[f * classes_ + k] = job.weights[static_cast<std::size_t>(k) * job.channels + f];
    }
  }

  void evaluate(Context& context, ClassLossJob& job) {
    const ClassLossRows rows{by_channel_.data(), by_class_.data(), biases_.data(), classes_, channels_};
    job.counted = static_cast<std::int32_t>(
        std::count_if(job.classes, job.classes + job.pixels, [](std::int32_t c) { return c >= 0; }));
    const float factor = job.counted > 0 ? 1.f / static_cast<float>(job.counted) : 0.f;
    const auto pixels = GGSLAM_DISPATCH(context.isa, class_loss_pixels);
    context.pool.parallel_for(parts_, 1, [&](std::size_t part, std::size_t, int) {
      const std::int64_t begin = static_cast<std::int64_t>(part) * part_, end = std::min(job.pixels, begin + part_);
      std::vector<float> scratch(class_loss_scratch(rows));
      float* sums = sums_.data() + part * classes_ * (channels_ + 1);
      losses_[part] = pixels(job, rows, factor, begin, end, scratch.data(), sums, sums + classes_ * channels_);
    });
    collect(job);
  }

 private:
  void collect(ClassLossJob& job) const {
    double loss = 0;
    for (double of_part : losses_) loss += of_part;
    job.loss = job.counted > 0 ? loss / job.counted : std::numeric_limits<double>::quiet_NaN();
    const std::size_t row = static_cast<std::size_t>(job.channels) + 1;
    std::fill_n(job.d_rows, row * job.class_count, 0.f);
    for (std::int64_t part = 0; part < parts_; ++part) {
      const float *sums = sums_.data() + part * classes_ * (channels_ + 1), *bias = sums + classes_ * channels_;
      for (int k = 0; k < job.class_count; ++k) {
        for (int f = 0; f < job.channels; ++f) job.d_rows[k * row + f] += sums[k * channels_ + f];
        job.d_rows[k * row + job.channels] += bias[k];
      }
    }
  }

  const std::size_t classes_, channels_;
  const std::int64_t part_, parts_;
  std::vector<float> by_channel_, by_class_, biases_, sums_;
  std::vector<double> losses_;
};

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_class_loss(void* context, ggslam::ClassLossJob* job_) try {
  using namespace ggslam;
  ClassLossJob& job = object_of<ClassLossJob>(job_);
  check_range("channels", job.channels, 1, 1 << 12);
  check_range("class_count", job.class_count, 0, 1 << 16);
  check_range<std::int64_t>("pixels", job.pixels, 0, std::int64_t{1} << 30);
  const void* const arrays[] = {job.features, job.classes, job.d_features};
  for (const void* array : arrays) check_array("pixels", array, job.pixels);
  for (const void* array : {job.weights, job.biases, static_cast<const float*>(job.d_rows)})
    check_array("classifier", array, job.class_count);
  for (std::int64_t i = 0; i < job.pixels; ++i) check_range("classes", job.classes[i], -1, job.class_count - 1);
  ClassLoss(job).evaluate(object_of<Context>(context), job);
  return 0;
} GGSLAM_CATCH_ALL
