// SPDX-License-Identifier: Apache-2.0
// Sums of a splat's gradients over the pixels of a warp.
//
// Compositing goes through splats one by one, with one pixel per lane; summing 26 values over 32 lanes for each splat
// would cost far more than working them out. But each value is the product of something that changes with the splat, its
// weight or its G = d loss / d log(alpha) at the pixel, and something that does not: the pixel's image gradients and
// place. So a warp queues only weight and G, in shared memory, and after eight splats changes roles: a lane then stands
// for one splat and one row of eight pixels, and sums along the row in registers. Two rounds of shuffles join the four
// rows. Sums go to the Gaussians' rows of gradients by atomic additions, four neighbouring floats of eight splats at a
// time.
#pragma once
#include "tile.cuh"

namespace ggslam::cuda {

constexpr int kQueued = 8;         // splats
constexpr int kQueueStride = 36;   // floats from one splat's 32 pixels to the next: rows start in different banks
constexpr int kBaseChannels = 4;   // red, green, blue, depth

// Where the summed gradients go.
struct GradientRows {
  float* rows;  // [N, stride]: base gradients, then features
  int stride;
  std::uint8_t* touched;  // [N]
};

// One warp's part of shared memory.
template <int kFeatures>
struct __align__(16) WarpQueue {
  static constexpr int kChannels = kBaseChannels + kFeatures;
  static constexpr int kRowStride = kWarpWidth * kChannels + 4;  // rows of pixels start in different banks
  float image_gradients[kWarpHeight * kRowStride];  // [row][column][channel]
  float weights[kQueued * kQueueStride], log_alphas[kQueued * kQueueStride];  // [splat][pixel]

  __device__ float* pixel(int lane) {
    return image_gradients + lane / kWarpWidth * kRowStride + lane % kWarpWidth * kChannels;
  }
};

// What a lane knows of the queued splat that it will stand for, number lane % kQueued.
struct QueuedSplat {
  float mean_x, mean_y;
  std::uint32_t row;
};

// Sums along the lane's row of pixels, into the values in the order of a row of gradients. left, y: of that row's first
// pixel, from the splat's mean.
template <int kFeatures, int kValues>
__device__ inline void sum_row(const WarpQueue<kFeatures>& queue, int lane, float left, float y,
                               float (&values)[kValues]) {
  constexpr int kQuads = WarpQueue<kFeatures>::kChannels / 4;
  const int row = lane / kQueued, place = lane % kQueued * kQueueStride + row * kWarpWidth;
  float4 sums[kQuads];
#pragma unroll
  for (float4& sum : sums) sum = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
  float m0 = 0.0f, mx = 0.0f, mxx = 0.0f;
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    const float4 w = *reinterpret_cast<const float4*>(queue.weights + place + 4 * half);
    const float4 g = *reinterpret_cast<const float4*>(queue.log_alphas + place + 4 * half);
    const float weights[4] = {w.x, w.y, w.z, w.w}, log_alphas[4] = {g.x, g.y, g.z, g.w};
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      const int column = 4 * half + i;
      const float* pixel = queue.image_gradients + row * queue.kRowStride + column * queue.kChannels;
#pragma unroll
      for (int quad = 0; quad < kQuads; ++quad) {
        const float4 v = *reinterpret_cast<const float4*>(pixel + 4 * quad);
        sums[quad].x += weights[i] * v.x, sums[quad].y += weights[i] * v.y;
        sums[quad].z += weights[i] * v.z, sums[quad].w += weights[i] * v.w;
      }
      const float x = left + static_cast<float>(column), moment = log_alphas[i] * x;
      m0 += log_alphas[i], mx += moment, mxx += moment * x;
    }
  }
  values[0] = m0, values[1] = mx, values[2] = m0 * y, values[3] = mxx, values[4] = mx * y, values[5] = m0 * y * y;
#pragma unroll
  for (int quad = 0; quad < kQuads; ++quad) {
    values[6 + 4 * quad] = sums[quad].x, values[7 + 4 * quad] = sums[quad].y;
    values[8 + 4 * quad] = sums[quad].z, values[9 + 4 * quad] = sums[quad].w;
  }
}

// Adds up the four rows' values; afterwards values[i] of a lane of row r is the sum of value 4 i + r.
template <int kValues>
__device__ inline void join_rows(int lane, float (&values)[kValues]) {
  const bool upper = (lane & 16) != 0, odd = (lane & 8) != 0;
#pragma unroll
  for (int i = 0; i < kValues / 4; ++i) {
    float pair[2];
#pragma unroll
    for (int b = 0; b < 2; ++b) {
      const float low = values[4 * i + b], high = values[4 * i + 2 + b];
      pair[b] = (upper ? high : low) + __shfl_xor_sync(kAllLanes, upper ? low : high, 16);
    }
    values[i] = (odd ? pair[1] : pair[0]) + __shfl_xor_sync(kAllLanes, odd ? pair[0] : pair[1], 8);
  }
}

// Adds the gradients of the first `count` queued splats to their Gaussians' rows. x, y: first pixel of the warp. All
// lanes of the warp must call this.
template <int kFeatures>
__device__ inline void empty_queue(const WarpQueue<kFeatures>& queue, const QueuedSplat& mine, int count, float x,
                                   float y, const FeatureGroup& group, const GradientRows& out) {
  constexpr int kUsed = kBaseGradients + kFeatures, kValues = (kUsed + 3) / 4 * 4;
  const int lane = threadIdx.x % kWarp, row = lane / kQueued;
  float values[kValues];
#pragma unroll
  for (int i = kUsed; i < kValues; ++i) values[i] = 0.0f;
  __syncwarp();  // the queue has been written
  sum_row<kFeatures>(queue, lane, x - mine.mean_x, y + static_cast<float>(row) - mine.mean_y, values);
  __syncwarp();  // and may be written again
  join_rows(lane, values);
  if (lane % kQueued >= count) return;
  float* gradients = out.rows + static_cast<std::int64_t>(mine.row) * out.stride;
#pragma unroll
  for (int i = 0; i < kValues / 4; ++i) {
    const int value = 4 * i + row;
    if (value < kBaseGradients + group.count)
      atomicAdd(gradients + (value < kBaseGradients ? value : value + group.first), values[i]);
  }
}

}  // namespace ggslam::cuda
