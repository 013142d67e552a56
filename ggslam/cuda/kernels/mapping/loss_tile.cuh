// SPDX-License-Identifier: Apache-2.0
// Pixels of a tile of the image loss, the target there, blurring by the window of SSIM, and sums over a block.
#pragma once
#include "mapping/image_loss.cuh"
#include "common/warp_reduction.cuh"

namespace ggslam::cuda {

constexpr int kBlurRadius = 5, kBlurTaps = 11;
constexpr int kHaloWide = kLossTileWide + 2 * kBlurRadius, kHaloHigh = kLossTileHigh + 2 * kBlurRadius;
// exp(-k^2 / (2 1.5^2)) for k = 0..5, divided by the sum over -5..5.
constexpr float kWindow0 = 0.2660117248617943f, kWindow1 = 0.21300553771125366f, kWindow2 = 0.1093606895097f;
constexpr float kWindow3 = 0.03600077212843082f, kWindow4 = 0.007598758135239184f, kWindow5 = 0.0010283800844791099f;

// The job with the images that are the target now.
__device__ inline void take_target(ImageLossJob& job) {
  if (job.target == nullptr) return;
  job.target_color = job.target->color, job.target_depth = job.target->depth, job.target_valid = job.target->valid;
  job.depth_scale = job.target->depth_scale, job.target_depth_is_float = job.target->depth_is_float;
}

// A tile of one channel (3: the depth image).
struct LossTile {
  int x, y, channel, number;
};

__device__ inline LossTile tile_of_block(const LossTiles& tiles) {
  const int block = static_cast<int>(blockIdx.x), number = block % tiles.count();
  return {number % tiles.wide * kLossTileWide, number / tiles.wide * kLossTileHigh, block / tiles.count(), number};
}

// A thread's column, and the upper of its rows, in the tile.
__device__ inline int column_of_thread() { return static_cast<int>(threadIdx.x) % kLossTileWide; }
__device__ inline int row_of_thread() { return static_cast<int>(threadIdx.x) / kLossTileWide * kPixelsPerThread; }

__device__ inline bool is_inside(const ImageLossJob& job, int x, int y) {
  return x >= 0 && y >= 0 && x < job.width && y < job.height;
}

__device__ inline std::int64_t pixel_index(const ImageLossJob& job, int x, int y) {
  return static_cast<std::int64_t>(y) * job.width + x;
}

// Metres, 0 where there is none.
__device__ inline float target_depth(const ImageLossJob& job, std::int64_t pixel) {
  if (job.target_depth_is_float == 0)
    return static_cast<float>(static_cast<const std::uint16_t*>(job.target_depth)[pixel]) * job.depth_scale;
  const float units = static_cast<const float*>(job.target_depth)[pixel];
  return (units > 0.0f && units <= 3e38f ? units : 0.0f) * job.depth_scale;
}

struct Exposure {
  float gain, offset;
  float saturated_from;  // colour of the target, 0 to 255, from which a pixel does not count; infinite: all do
};

__device__ inline Exposure exposure_of(const ImageLossJob& job, int channel) {
  if (job.exposure == nullptr) return {1.0f, 0.0f, INFINITY};
  float change = 1.0f;
  for (int c = 0; c < 3; ++c) change *= fmaxf(job.exposure[2 * c], 1e-6f);
  const float gain = job.overexposed_gain;
  const bool over = job.saturated_from > 0.0f && change > gain * gain * gain;
  return {job.exposure[2 * channel], job.exposure[2 * channel + 1], over ? job.saturated_from : INFINITY};
}

// One channel of a pixel on both sides.
struct ColorPair {
  float rendered, target;  // as they are
  float depth, weight;     // of the target; how much the colour counts
  float corrected;         // rendered, after the exposure
  float residual;          // weighted
};

__device__ inline ColorPair color_pair(const ImageLossJob& job, const Exposure& exposure, int channel,
                                       std::int64_t pixel) {
  ColorPair p;
  p.rendered = job.image[static_cast<std::int64_t>(channel) * job.height * job.width + pixel];
  p.target = static_cast<float>(job.target_color[3 * pixel + channel]) * (1.0f / 255);
  p.depth = target_depth(job, pixel);
  p.weight = p.depth > 0.0f ? 1.0f : job.no_depth_weight;
  if (job.target_valid != nullptr && job.target_valid[pixel] == 0) p.weight = 0.0f;
  if (exposure.saturated_from < INFINITY) {
    const std::uint8_t* color = job.target_color + 3 * pixel;
    for (int c = 0; c < 3; ++c)
      if (static_cast<float>(color[c]) >= exposure.saturated_from) p.weight = 0.0f;
  }
  p.corrected = exposure.gain * p.rendered + exposure.offset;
  p.residual = p.weight * (p.corrected - p.target);
  return p;
}

// Weighted sum of kBlurTaps values.
__device__ inline float blur(const float* v) {
  return kWindow0 * v[5] + kWindow1 * (v[4] + v[6]) + kWindow2 * (v[3] + v[7]) + kWindow3 * (v[2] + v[8]) +
         kWindow4 * (v[1] + v[9]) + kWindow5 * (v[0] + v[10]);
}

// Rows of a tile and its halo after blurring along the rows.
using BlurredRows = float[kHaloHigh][kLossTileWide];

// Blurs along a thread's column; one result for each of its pixels.
__device__ inline void blur_column(const BlurredRows& rows, float (&out)[kPixelsPerThread]) {
  float v[kBlurTaps + kPixelsPerThread - 1];
#pragma unroll
  for (int i = 0; i < kBlurTaps + kPixelsPerThread - 1; ++i) v[i] = rows[row_of_thread() + i][column_of_thread()];
#pragma unroll
  for (int i = 0; i < kPixelsPerThread; ++i) out[i] = blur(v + i);
}

// Writes the block's sums of values[k] to out[k * stride].
template <int kCount>
__device__ inline void write_block_sums(float (&values)[kCount], double* out, std::int64_t stride) {
  GGSLAM_SHARED float of_warps[kLossThreads / kWarp][kCount];
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const float sum = sum_over_warp(values, lane);
  if (lane < kCount) of_warps[warp][lane] = sum;
  __syncthreads();
  if (static_cast<int>(threadIdx.x) >= kCount) return;
  double total = 0.0;
  for (int i = 0; i < kLossThreads / kWarp; ++i) total += static_cast<double>(of_warps[i][threadIdx.x]);
  out[threadIdx.x * stride] = total;
}

__device__ inline float sign_of(float x) { return static_cast<float>(x > 0.0f) - static_cast<float>(x < 0.0f); }

}  // namespace ggslam::cuda
