// SPDX-License-Identifier: Apache-2.0
// Entry points of the image loss: scratch memory that lives across calls, bands handed to threads, sums added up.
#include <algorithm>
#include <cmath>
#include <limits>
#include <new>
#include <vector>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "mapping/image_loss.hpp"

namespace ggslam {
namespace {

// A band repeats 10 rows of blurring above and below itself; more bands balance better over threads.
constexpr int kBandRows = 120;
constexpr int kPrepareRows = 32;

class ImageLossWorkspace {
 public:
  void resize(int height, int width, int threads) {
    if (height == height_ && width == width_ && threads <= threads_) return;
    height_ = width_ = threads_ = 0;  // stays so if an allocation below throws
    const std::size_t stride = image_loss_stride(width), plane = stride * height;
    row_floats_ = image_loss_row_floats(stride);
    memory_.assign(5 * plane + stride + threads * row_floats_ + 16, 0.f);
    float* base = memory_.data();
    base += (64 - reinterpret_cast<std::uintptr_t>(base) % 64) % 64 / sizeof(float);
    planes_ = {{base, base + plane, base + 2 * plane}, base + 3 * plane, base + 4 * plane, base + 5 * plane,
                stride};
    std::fill_n(planes_.columns, width, 1.f);
    rows_ = base + 5 * plane + stride;
    bands_ = (height + kBandRows - 1) / kBandRows;
    sums_.assign(4 * bands_, ImageLossSums{});
    counts_.assign((height + kPrepareRows - 1) / kPrepareRows, 0);
    height_ = height, width_ = width, threads_ = threads;
  }

  void evaluate(Context& context, ImageLossJob& job) {
    resize(job.height, job.width, context.pool.size());
    prepare(context, job);
    std::fill(sums_.begin(), sums_.end(), ImageLossSums{});
    const auto color_band = GGSLAM_DISPATCH(context.isa, image_loss_color_band);
    const auto depth_band = GGSLAM_DISPATCH(context.isa, image_loss_depth_band);
    context.pool.parallel_for(sums_.size(), 1, [&](std::size_t index, std::size_t, int thread) {
      const int channel = static_cast<int>(index / bands_);  // 3: the depth image
      const int begin = static_cast<int>(index % bands_) * kBandRows, end = std::min(job.height, begin + kBandRows);
      float* rows = rows_ + thread * row_floats_;
      if (channel < 3) color_band(job, planes_, rows, channel, begin, end, sums_[index]);
      else depth_band(job, planes_, rows, begin, end, sums_[index]);
    });
    collect(job);
  }

 private:
  void prepare(Context& context, ImageLossJob& job) {
    const auto kernel = GGSLAM_DISPATCH(context.isa, image_loss_prepare);
    context.pool.parallel_for(counts_.size(), 1, [&](std::size_t index, std::size_t, int) {
      const int begin = static_cast<int>(index) * kPrepareRows, end = std::min(job.height, begin + kPrepareRows);
      counts_[index] = kernel(job, planes_, begin, end);
    });
    job.valid_pixels = 0;
    for (long long count : counts_) job.valid_pixels += static_cast<double>(count);
  }

  void collect(ImageLossJob& job) const {
    ImageLossSums all{};
    for (double& gradient : job.exposure_gradient) gradient = 0;
    for (std::size_t i = 0; i < sums_.size(); ++i) {
      const ImageLossSums& band = sums_[i];
      all.absolute += band.absolute, all.robust += band.robust, all.squared += band.squared, all.ssim += band.ssim;
      all.depth += band.depth, all.depth_pixels += band.depth_pixels, all.transparency += band.transparency;
      if (i >= 3 * bands_) continue;
      job.exposure_gradient[i / bands_ * 2] += band.gain;
      job.exposure_gradient[i / bands_ * 2 + 1] += band.offset;
    }
    constexpr double kNothing = std::numeric_limits<double>::quiet_NaN();
    const double values = 3.0 * job.height * job.width, valid = job.valid_pixels;
    job.l1 = all.absolute / values;
    job.color = all.robust / values;
    job.ssim = job.dssim_weight > 0 ? all.ssim / values : kNothing;
    job.depth_term = valid > 0 ? all.depth / valid : 0;
    job.opacity_term = valid > 0 ? all.transparency / valid : 0;
    job.depth_l1_m = all.depth_pixels > 0 ? all.depth / all.depth_pixels : kNothing;
    job.psnr = valid > 0 ? -10 * std::log10(all.squared / (3 * valid)) : kNothing;
    job.total = (1.0 - job.dssim_weight) * job.color + job.depth_weight * job.depth_term +
                job.opacity_weight * job.opacity_term;
    if (job.dssim_weight > 0) job.total += job.dssim_weight * (1.0 - job.ssim);
  }

  int height_ = 0, width_ = 0, threads_ = 0;
  std::size_t bands_ = 0, row_floats_ = 0;
  std::vector<float> memory_;
  ImageLossPlanes planes_{};
  float* rows_ = nullptr;
  std::vector<ImageLossSums> sums_;
  std::vector<long long> counts_;
};

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT void* ggslam_image_loss_create() try {
  return new (std::nothrow) ggslam::ImageLossWorkspace;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_image_loss_destroy(void* workspace) try {
  delete static_cast<ggslam::ImageLossWorkspace*>(workspace);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_image_loss_evaluate(void* context, void* workspace, ggslam::ImageLossJob* job) try {
  using namespace ggslam;
  ImageLossJob& all = object_of<ImageLossJob>(job);
  check_range("height", all.height, 1, kMostPixelsAlong);
  check_range("width", all.width, 1, kMostPixelsAlong);
  check_range("target_row", all.target_row, 1, kMostPixelsAlong);
  check_range("target_step", all.target_step, 1, all.target_row);
  const void* const images[] = {all.image,        all.depth,   all.alpha,   all.target_color,
                                all.target_depth, all.d_image, all.d_depth, all.d_alpha};
  for (const void* image : images) check_array("images", image, 1);
  object_of<ImageLossWorkspace>(workspace).evaluate(object_of<Context>(context), all);
  return 0;
} GGSLAM_CATCH_ALL
