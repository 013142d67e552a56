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
#include "common/block_median.cuh"

namespace ggslam::cuda {

constexpr int kPointThreads = 128;

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

// Number of points and their median depth, by one block.
__global__ void __launch_bounds__(kMedianThreads) median_depth_kernel(DepthPointsJob job) {
  GGSLAM_SHARED unsigned room[kMedianThreads / kWarp];
  const int cells = job.columns * job.rows;
  const std::uint32_t* words = static_cast<const std::uint32_t*>(job.workspace);
  unsigned found = 0;
  for (int w = static_cast<int>(threadIdx.x); w < (cells + kWarp - 1) / kWarp; w += kMedianThreads)
    found += __popc(words[w]);
  const int count = static_cast<int>(sum_over_block<kMedianThreads>(found, room));
  const float median = block_median(
      count, count, [&](int i) { return __float_as_uint(job.out.points[3 * static_cast<std::int64_t>(i) + 2]); }, room);
  if (threadIdx.x == 0) *job.out.header = {count, median};
}

}  // namespace ggslam::cuda
