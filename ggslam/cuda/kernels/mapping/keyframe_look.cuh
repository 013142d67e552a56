// SPDX-License-Identifier: Apache-2.0
// What a new keyframe sees of the map: what there is nothing to add to, and how bright it is against it, as
// SeenAgain.measure (ggslam/rendering/exposure.py).
#pragma once
#include "abi/cuda/seen_map.hpp"
#include "common/block_median.cuh"
#include "common/platform.cuh"

namespace ggslam::cuda {

constexpr int kLookThreads = 256;
constexpr float kLeastAlpha = 1e-3f;  // of a pixel that shows some depth, as RenderBuffers.expected_depth
constexpr float kLabelAlpha = 0.5f;   // below it a pixel shows no object
constexpr float kNoRatio = -1.0f;

// Pixels at every stride-th row and column.
__host__ __device__ inline std::int64_t thinned_wide(const KeyframeLookJob& job, int stride) {
  return (job.width + stride - 1) / stride;
}

__host__ __device__ inline std::int64_t thinned_pixels(const KeyframeLookJob& job, int stride) {
  return thinned_wide(job, stride) * ((job.height + stride - 1) / stride);
}

// Whether both see the same surface at a pixel where the map shows this depth with this opacity.
__device__ inline bool sees_the_same(const KeyframeLookJob& job, std::int64_t pixel, float alpha, float depth) {
  const float measured = static_cast<float>(job.measured_depth[pixel]) / job.units_per_metre;
  return measured > 0.0f && alpha > job.least_alpha && fabsf(depth - measured) < job.largest_depth_error * measured;
}

__device__ inline void write_ratios(const KeyframeLookJob& job, std::int64_t pixel, bool is_known, float* out) {
  const std::int64_t pixels = static_cast<std::int64_t>(job.height) * job.width;
  for (int k = 0; k < 3; ++k, out += thinned_pixels(job, job.ratio_stride)) {
    const float shown = job.image[k * pixels + pixel];
    const float measured = static_cast<float>(job.measured_color[3 * pixel + k]) / 255.0f;
    const bool tells = shown > job.dark && shown < job.bright && measured < job.bright;
    *out = is_known && tells ? measured / shown : kNoRatio;
  }
}

// A thread for each pixel.
__global__ void __launch_bounds__(kLookThreads) keyframe_look_kernel(KeyframeLookJob job) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kLookThreads + threadIdx.x;
  if (i == 0) *job.was_short = *job.overflowed;
  if (i >= static_cast<std::int64_t>(job.height) * job.width) return;
  const float alpha = job.alpha[i];
  const float depth = alpha >= kLeastAlpha ? job.depth[i] / alpha : 0.0f;
  job.explained_alpha[i] = job.valid != nullptr && job.valid[i] == 0 ? 1.0f : alpha;
  job.explained_depth[i] = depth;
  const int row = static_cast<int>(i / job.width), column = static_cast<int>(i % job.width);
  const auto place = [&](int stride) { return row / stride * thinned_wide(job, stride) + column / stride; };
  if (job.ratios != nullptr && row % job.ratio_stride == 0 && column % job.ratio_stride == 0)
    write_ratios(job, i, sees_the_same(job, i, alpha, depth), job.pixel_ratios + place(job.ratio_stride));
  const bool labelled = job.shares != nullptr && row % job.label_stride == 0 && column % job.label_stride == 0;
  if (labelled && !(alpha > kLabelAlpha)) job.shares[place(job.label_stride)] = 0.0f;
}

// A block for each channel.
__global__ void __launch_bounds__(kMedianThreads) brightness_kernel(KeyframeLookJob job) {
  GGSLAM_SHARED unsigned room[kMedianThreads / kWarp];
  const int channel = static_cast<int>(blockIdx.x);
  const int count = static_cast<int>(thinned_pixels(job, job.ratio_stride));
  const float* ratios = job.pixel_ratios + static_cast<std::int64_t>(channel) * count;
  const auto bits_of = [&](int i) { return ratios[i] < 0.0f ? kLeftOut : __float_as_uint(ratios[i]); };
  unsigned found = 0;
  for (int i = static_cast<int>(threadIdx.x); i < count; i += kMedianThreads) found += bits_of(i) != kLeftOut;
  const int used = static_cast<int>(sum_over_block<kMedianThreads>(found, room));
  const float median = block_median(count, used, bits_of, room);
  if (threadIdx.x != 0) return;
  job.ratios->used[channel] = used;
  job.ratios->medians[channel] = median;
}

}  // namespace ggslam::cuda
