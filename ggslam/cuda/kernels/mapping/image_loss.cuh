// SPDX-License-Identifier: Apache-2.0
// The arguments of the image loss, the memory it works in, and how an image is cut into tiles. The loss is that of
// native/src/mapping/image_loss.hpp, stated in ggslam/mapping/cpu/losses.py.
#pragma once
#include "common/carver.cuh"

namespace ggslam::cuda {

// One evaluation, all pointers lead to device memory. ggslam/mapping/cuda/losses.py mirrors it field by field.
struct ImageLossJob {
  // Rendered: colour [3, H, W], accumulated depth [H, W] in metres, alpha [H, W].
  const float *image, *depth, *alpha;
  // Target: colour [H, W, 3], depth [H, W] (uint16 or float, see target_depth_is_float), 0 = none.
  const std::uint8_t* target_color;
  const void* target_depth;
  const float* exposure;  // [3][2], gain and offset of R, G, B; null: 1 and 0
  // Gradients of the loss, shaped like the rendered images.
  float *d_image, *d_depth, *d_alpha;
  double* results;  // [kLossResults], in the order of LossResult
  void* workspace;
  void* stream;
  std::int32_t device, height, width;
  std::int32_t target_depth_is_float;
  std::int32_t normalised_depth;  // compare depth / alpha with the target instead of depth
  std::int32_t charbonnier;       // sqrt(r^2 + eps^2) - eps instead of |r| for colour
  float depth_scale;              // metres per unit of target_depth
  float dssim_weight, depth_weight, opacity_weight, no_depth_weight, minimum_alpha, charbonnier_epsilon;
};

// NaN where nothing was measured. The gradient of the exposure, [3][2], follows.
enum LossResult { kTotal, kColor, kL1, kSsim, kDepth, kOpacity, kDepthL1, kPsnr, kValidPixels, kExposureGradient };
constexpr int kLossResults = kExposureGradient + 6;

// Sums over the pixels of a tile. Those of colour are per channel: row kind * 3 + channel of the partial sums.
enum LossSum { kAbsolute, kRobust, kSquared, kGain, kOffset, kSimilarity, kColorSums };
constexpr int kDepthSumRow = 3 * kColorSums;  // depth, pixels that count for it, transparency
constexpr int kSumRows = kDepthSumRow + 3;

constexpr int kLossTileWide = 32, kLossTileHigh = 16;  // pixels
constexpr int kLossThreads = 256;                      // each takes two pixels, one below the other
constexpr int kPixelsPerThread = 2;
static_assert(kLossThreads * kPixelsPerThread == kLossTileWide * kLossTileHigh, "all pixels of a tile are taken");

struct LossTiles {
  int wide, high;
  __host__ __device__ int count() const { return wide * high; }
};

inline LossTiles loss_tiles(const ImageLossJob& job) {
  return {(job.width + kLossTileWide - 1) / kLossTileWide, (job.height + kLossTileHigh - 1) / kLossTileHigh};
}

struct LossWorkspace {
  std::uint32_t* valid_pixels;  // [1]
  double* sums;                 // [kSumRows, tiles]: every block writes to places of its own, so sums have one order
  float* derivatives;           // [3, 3, H, W]: dS/dmx, 2 dS/dE[x^2], dS/dE[xy] of each channel
  std::size_t bytes;
};

inline LossWorkspace loss_workspace(void* block, const ImageLossJob& job) {
  const std::int64_t pixels = static_cast<std::int64_t>(job.height) * job.width;
  Carver carver(block);
  LossWorkspace w;
  w.valid_pixels = carver.take<std::uint32_t>(1);
  w.sums = carver.take<double>(static_cast<std::int64_t>(kSumRows) * loss_tiles(job).count());
  w.derivatives = carver.take<float>(job.dssim_weight > 0 ? 9 * pixels : 0);
  w.bytes = carver.used();
  return w;
}

}  // namespace ggslam::cuda
