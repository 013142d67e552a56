// SPDX-License-Identifier: Apache-2.0
// Points of a depth image on a grid of pixels, with normals and covariances from their neighbours in the image: the
// rules of native/src/tracking/kernels/depth_points.cpp.
//
// A first pass notes which grid points are good, one bit each; a second one counts the bits before its own, so that
// points are written in the order of the image whatever the order of the blocks.
#pragma once
#include "common/platform.cuh"
#include "abi/cuda/tracking.hpp"
#include "native/formulas/depth_window.hpp"

namespace ggslam::cuda {

constexpr int kPointThreads = 128;
constexpr int kMedianThreads = 1024;

struct GridPoint {
  int u, v;
  float z;
};

// The pixel of a grid point; false outside the grid or without usable depth.
__device__ inline bool grid_point(const DepthPointsJob& job, int cell, GridPoint* point) {
  const DepthPointsSettings& s = job.settings;
  if (cell >= job.columns * job.rows) return false;
  const int first = s.window * s.window_step + s.stride / 2;
  point->u = first + cell % job.columns * s.stride;
  point->v = first + cell / job.columns * s.stride;
  point->z = job.depth[point->v * s.width + point->u];
  return point->z >= s.min_depth && point->z <= s.max_depth;
}

// One bit for each grid point: whether it has depth and enough neighbours.
__global__ void __launch_bounds__(kPointThreads) find_points_kernel(DepthPointsJob job) {
  const int cell = static_cast<int>(blockIdx.x * kPointThreads + threadIdx.x);
  GridPoint point;
  float scatter[6];
  const bool good = grid_point(job, cell, &point) && window_scatter(job.depth, job.settings, point.u, point.v, point.z, scatter);
  const unsigned bits = __ballot_sync(kAllLanes, good);
  if (threadIdx.x % kWarp == 0) static_cast<std::uint32_t*>(job.workspace)[cell / kWarp] = bits;
}

// Sum of `value` over the block; `room` is shared memory.
template <int kThreads>
__device__ inline unsigned sum_over_block(unsigned value, unsigned (&room)[kThreads / kWarp]) {
  const unsigned of_warp = __reduce_add_sync(kAllLanes, value);
  if (threadIdx.x % kWarp == 0) room[threadIdx.x / kWarp] = of_warp;
  __syncthreads();
  unsigned sum = 0;
#pragma unroll
  for (int w = 0; w < kThreads / kWarp; ++w) sum += room[w];
  __syncthreads();
  return sum;
}

__device__ inline void write_point(const DepthPointsJob& job, const GridPoint& at, std::int64_t n) {
  const PointArrays& out = job.out;
  float scatter[6] = {0, 0, 0, 0, 0, 0};
  window_scatter(job.depth, job.settings, at.u, at.v, at.z, scatter);
  out.weights[n] = describe_point(job.settings, at.u, at.v, at.z, scatter, out.points + 3 * n, out.normals + 3 * n,
                                  out.covariances + 6 * n);
  out.pixels[2 * n] = at.u, out.pixels[2 * n + 1] = at.v;
}

// Writes the good points, each behind those before it.
__global__ void __launch_bounds__(kPointThreads) write_points_kernel(DepthPointsJob job) {
  GGSLAM_SHARED unsigned room[kPointThreads / kWarp];
  const std::uint32_t* words = static_cast<const std::uint32_t*>(job.workspace);
  const int cell = static_cast<int>(blockIdx.x * kPointThreads + threadIdx.x), own = cell / kWarp;
  const int first = static_cast<int>(blockIdx.x) * (kPointThreads / kWarp);
  unsigned found = 0;
  for (int w = static_cast<int>(threadIdx.x); w < first; w += kPointThreads) found += __popc(words[w]);
  std::int64_t n = sum_over_block<kPointThreads>(found, room);
  for (int w = first; w < own; ++w) n += __popc(words[w]);
  const std::uint32_t bit = std::uint32_t{1} << (cell % kWarp);
  if (!(words[own] & bit)) return;
  n += __popc(words[own] & (bit - 1));
  GridPoint point;
  grid_point(job, cell, &point);
  write_point(job, point, n);
}

// Number of points and their median depth, the mean of the two middle ones if they are even in number. A block's work:
// the bits of the result are found one by one, for positive floats are in the order of their bits.
__global__ void __launch_bounds__(kMedianThreads) median_depth_kernel(DepthPointsJob job) {
  GGSLAM_SHARED unsigned room[kMedianThreads / kWarp];
  const int cells = job.columns * job.rows, thread = static_cast<int>(threadIdx.x);
  const std::uint32_t* words = static_cast<const std::uint32_t*>(job.workspace);
  unsigned found = 0;
  for (int w = thread; w < (cells + kWarp - 1) / kWarp; w += kMedianThreads) found += __popc(words[w]);
  const int count = static_cast<int>(sum_over_block<kMedianThreads>(found, room));
  const auto bits_of = [&](int i) { return __float_as_uint(job.out.points[3 * static_cast<std::int64_t>(i) + 2]); };
  const unsigned rank = static_cast<unsigned>(max(count - 1, 0) / 2);
  std::uint32_t lower = 0;  // the largest value that at most `rank` points are below
  for (int bit = 30; bit >= 0; --bit) {
    const std::uint32_t candidate = lower | std::uint32_t{1} << bit;
    unsigned below = 0;
    for (int i = thread; i < count; i += kMedianThreads) below += bits_of(i) < candidate;
    if (sum_over_block<kMedianThreads>(below, room) <= rank) lower = candidate;
  }
  // Its upper neighbour in order: the same value if it is there often enough, else the least of the larger ones.
  unsigned up_to = 0;
  std::uint32_t above = 0x7f7fffffu;
  for (int i = thread; i < count; i += kMedianThreads) {
    const std::uint32_t value = bits_of(i);
    up_to += value <= lower;
    if (value > lower) above = min(above, value);
  }
  const bool repeated = sum_over_block<kMedianThreads>(up_to, room) > static_cast<unsigned>(count / 2);
  const int least = -__reduce_max_sync(kAllLanes, -static_cast<int>(above));
  if (thread % kWarp == 0) room[thread / kWarp] = static_cast<unsigned>(least);
  __syncthreads();
  if (thread != 0) return;
  for (int w = 0; w < kMedianThreads / kWarp; ++w) above = min(above, room[w]);
  const float low = __uint_as_float(lower), high = repeated || count % 2 ? low : __uint_as_float(above);
  *job.out.header = {count, count ? 0.5f * (low + high) : 0.0f};
}

}  // namespace ggslam::cuda
