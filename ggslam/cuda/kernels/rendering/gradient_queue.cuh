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
#include "rendering/tile.cuh"

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

// A splat that is queued.
struct __align__(16) QueuedSplat {
  float mean_x, mean_y, slope_x;
  std::uint32_t row;
};

// One warp's part of shared memory.
template <int kFeatures>
struct __align__(16) WarpQueue {
  static constexpr int kChannels = kBaseChannels + kFeatures;
  static constexpr int kRowStride = kWarpWidth * kChannels + 4;  // rows of pixels start in different banks
  float image_gradients[kWarpHeight * kRowStride];  // [row][column][channel]
  float weights[kQueued * kQueueStride], log_alphas[kQueued * kQueueStride];  // [splat][pixel]
  QueuedSplat splats[kQueued];  // not in registers: there are none left where there are 16 features

  __device__ float* pixel(int lane) {
    return image_gradients + lane / kWarpWidth * kRowStride + lane % kWarpWidth * kChannels;
  }
};

// Eight numbers of the queue, of one splat and one row of pixels.
struct RowOfNumbers {
  float values[kWarpWidth];
};

__device__ inline RowOfNumbers load_row(const float* numbers, int lane) {
  const float* row = numbers + lane % kQueued * kQueueStride + lane / kQueued * kWarpWidth;
  const float4 a = *reinterpret_cast<const float4*>(row), b = *reinterpret_cast<const float4*>(row + 4);
  return {{a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w}};
}

// values[0..6): moments of G along the lane's row of pixels; left, y: r and dy of its first pixel, see Splat.
__device__ inline void sum_moments(const float* log_alphas, int lane, float left, float y, float* values) {
  const RowOfNumbers row = load_row(log_alphas, lane);
  float m0 = 0.0f, mr = 0.0f, mrr = 0.0f;
#pragma unroll
  for (int column = 0; column < kWarpWidth; ++column) {
    const float r = left + static_cast<float>(column), moment = row.values[column] * r;
    m0 += row.values[column], mr += moment, mrr += moment * r;
  }
  values[0] = m0, values[1] = mr, values[2] = m0 * y, values[3] = mrr, values[4] = mr * y, values[5] = m0 * y * y;
}

// values[0..4 kQuads): weight times image gradient along the lane's row, for channels from 4 kFirst on.
template <int kFirst, int kQuads, int kFeatures>
__device__ inline void sum_channels(const WarpQueue<kFeatures>& queue, int lane, float* values) {
  const RowOfNumbers weights = load_row(queue.weights, lane);
  const float* pixels = queue.image_gradients + lane / kQueued * queue.kRowStride + 4 * kFirst;
#pragma unroll
  for (int i = 0; i < 4 * kQuads; ++i) values[i] = 0.0f;
#pragma unroll
  for (int column = 0; column < kWarpWidth; ++column) {
#pragma unroll
    for (int quad = 0; quad < kQuads; ++quad) {
      const float4 v = *reinterpret_cast<const float4*>(pixels + column * queue.kChannels + 4 * quad);
      const float weight = weights.values[column];
      values[4 * quad] += weight * v.x, values[4 * quad + 1] += weight * v.y;
      values[4 * quad + 2] += weight * v.z, values[4 * quad + 3] += weight * v.w;
    }
  }
}

// Sums along the lane's row of pixels, in the order of a row of gradients.
template <int kFeatures>
__device__ inline void sum_row(const WarpQueue<kFeatures>& queue, int lane, float left, float y,
                               float (&values)[kBaseGradients + kFeatures]) {
  constexpr int kQuads = kFeatures / 4, kFirstHalf = (kQuads + 1) / 2;
  float* features = values + kBaseGradients;
  // Nothing is moved across __syncwarp: all sums at once would take more registers than there are.
  sum_moments(queue.log_alphas, lane, left, y, values);
  sum_channels<0, 1>(queue, lane, values + 6);
  values[10] = values[11] = 0.0f;
  if constexpr (kQuads > 0) {
    if constexpr (kQuads > 2) __syncwarp();
    sum_channels<1, kFirstHalf>(queue, lane, features);
  }
  if constexpr (kQuads > 1) {
    __syncwarp();
    sum_channels<1 + kFirstHalf, kQuads - kFirstHalf>(queue, lane, features + 4 * kFirstHalf);
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

// Adds the gradients of the first `count` queued splats to their Gaussians' rows. x, y: the lane's pixel. All lanes of
// the warp must call this.
template <int kFeatures>
__device__ inline void empty_queue(const WarpQueue<kFeatures>& queue, int count, float x, float y,
                                   const FeatureGroup& group, const GradientRows& out) {
  const int lane = threadIdx.x % kWarp;
  float values[kBaseGradients + kFeatures];
  __syncwarp();  // the queue has been written
  const QueuedSplat mine = queue.splats[lane % kQueued];  // that the lane stands for
  // The lane's own pixel lies in the row that it sums, as there are as many splats as pixels in a row.
  static_assert(kQueued == kWarpWidth, "a lane's row of pixels is the row that it sums");
  const float left = x - static_cast<float>(lane % kWarpWidth), dy = y - mine.mean_y;
  sum_row<kFeatures>(queue, lane, fmaf(-mine.slope_x, dy, left - mine.mean_x), dy, values);
  __syncwarp();  // and may be written again
  join_rows(lane, values);
  if (lane % kQueued >= count) return;
  float* gradients = out.rows + static_cast<std::int64_t>(mine.row) * out.stride + lane / kQueued;
#pragma unroll
  for (int i = 0; i < kBaseGradients / 4; ++i) atomicAdd(gradients + 4 * i, values[i]);
  gradients += group.first;
#pragma unroll
  for (int i = kBaseGradients / 4; i < (kBaseGradients + kFeatures) / 4; ++i) atomicAdd(gradients + 4 * i, values[i]);
}

}  // namespace ggslam::cuda
