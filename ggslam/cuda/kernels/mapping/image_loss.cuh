// SPDX-License-Identifier: Apache-2.0
// The arguments of the image loss, the memory it works in, and how an image is cut into tiles. The loss is that of
// native/src/mapping/image_loss.hpp, stated in ggslam/mapping/cpu/losses.py.
#pragma once
#include "common/carver.cuh"
#include "abi/cuda/mapping.hpp"

namespace ggslam::cuda {

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
