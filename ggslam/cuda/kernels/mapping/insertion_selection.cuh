// SPDX-License-Identifier: Apache-2.0
// Which pixels of a keyframe become Gaussians.
#pragma once
#include "mapping/insertion.cuh"

namespace ggslam::cuda::insertion {

constexpr int kTileWide = 32, kTileHigh = 8, kThreads = kTileWide * kTileHigh;

// Grey and depth around a tile; edges need one pixel around it, and they in turn one more.
struct TileImages {
  float grey[kTileHigh + 4][kTileWide + 4], depth[kTileHigh + 4][kTileWide + 4];
  float edge[kTileHigh + 2][kTileWide + 2];
};

// Grey of 0 to 255 as OpenCV rounds it, in fixed point of 15 bits.
__device__ inline float grey_at(const InsertionJob& job, int x, int y) {
  const std::uint8_t* c = job.color + 3 * (static_cast<std::int64_t>(y) * job.width + x);
  return static_cast<float>((9798 * c[0] + 19235 * c[1] + 3735 * c[2] + (1 << 14)) >> 15);
}

// |d/dx| + |d/dy| by Sobel's filter, with (row, column) the upper left of the 3 x 3 values.
__device__ inline float sobel(const float (&v)[kTileHigh + 4][kTileWide + 4], int row, int column) {
  const float *a = &v[row][column], *b = &v[row + 1][column], *c = &v[row + 2][column];
  const float dx = (a[2] - a[0]) + (c[2] - c[0]) + 2.0f * (b[2] - b[0]);
  const float dy = (c[0] + c[2] + 2.0f * c[1]) - (a[0] + a[2] + 2.0f * a[1]);
  return fabsf(dx) + fabsf(dy);
}

// Whether neither colour nor depth has an edge in the 3 x 3 pixels around the thread's. All threads of a block call it.
__device__ inline bool is_flat(const InsertionJob& job, int tile_x, int tile_y) {
  GGSLAM_SHARED TileImages t;
  for (int k = threadIdx.x; k < (kTileHigh + 4) * (kTileWide + 4); k += kThreads) {
    const int row = k / (kTileWide + 4), column = k % (kTileWide + 4);
    const int x = reflected(tile_x + column - 2, job.width), y = reflected(tile_y + row - 2, job.height);
    t.grey[row][column] = grey_at(job, x, y);
    t.depth[row][column] = depth_at(job, x, y);
  }
  __syncthreads();
  for (int k = threadIdx.x; k < (kTileHigh + 2) * (kTileWide + 2); k += kThreads) {
    const int row = k / (kTileWide + 2), column = k % (kTileWide + 2);
    const int x = tile_x + column - 1, y = tile_y + row - 1;
    const bool inside = x >= 0 && x < job.width && y >= 0 && y < job.height;
    const bool step = sobel(t.depth, row, column) > 0.3f * t.depth[row + 1][column + 1];
    t.edge[row][column] = inside ? (step ? 1e3f : sobel(t.grey, row, column)) : 0.0f;
  }
  __syncthreads();
  const int row = threadIdx.x / kTileWide, column = threadIdx.x % kTileWide;
  float largest = 0.0f;
  for (int k = 0; k < 9; ++k) largest = fmaxf(largest, t.edge[row + k / 3][column + k % 3]);
  return largest < job.texture_threshold;
}

// Whether the map does not explain the pixel.
__device__ inline bool is_unexplained(const InsertionJob& job, std::int64_t pixel, float z) {
  if (job.alpha == nullptr) return true;
  const float tolerance = fmaxf(job.depth_tolerance_m, job.depth_tolerance_relative * z);
  return job.alpha[pixel] < job.alpha_threshold || z < job.rendered_depth[pixel] - tolerance;
}

// Chooses among the pixels of a tile, a block for each.
__global__ void __launch_bounds__(kThreads) choose_kernel(InsertionJob job, int tiles_wide, Workspace w) {
  const int tile_x = static_cast<int>(blockIdx.x) % tiles_wide * kTileWide;
  const int tile_y = static_cast<int>(blockIdx.x) / tiles_wide * kTileHigh;
  const int x = tile_x + static_cast<int>(threadIdx.x) % kTileWide;
  const int y = tile_y + static_cast<int>(threadIdx.x) / kTileWide;
  const std::int64_t pixel = static_cast<std::int64_t>(y) * job.width + x;
  const bool inside = x < job.width && y < job.height;
  const float z = inside ? depth_at(job, x, y) : 0.0f;
  const bool wanted = z > 0.05f && z < job.max_depth_m && is_unexplained(job, pixel, z);
  bool flat = false;  // need not be known where nothing is inserted
  if (job.adaptive_stride != 0 && __syncthreads_count(wanted) > 0) flat = is_flat(job, tile_x, tile_y);
  if (!inside) return;
  const bool on_grid = !flat || (x % 2 == 1 && y % 2 == 1);
  w.chosen[pixel] = wanted && on_grid ? 1u : 0u;
  w.coarse[pixel] = flat ? 1 : 0;
}

// Writes the chosen candidates' numbers one after the other, and how many there are.
__global__ void __launch_bounds__(kThreads) collect_kernel(InsertionJob job, Candidates candidates, Workspace w) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= candidates.count) return;
  if (i == candidates.count - 1) *job.total = static_cast<std::int32_t>(w.sums[i]);
  if (w.chosen[i] == 0) return;
  const bool coarse = i < candidates.pixels && w.coarse[i] != 0;
  w.order[w.sums[i] - 1] = static_cast<std::uint32_t>(i) | (coarse ? kCoarse : 0u);
}

}  // namespace ggslam::cuda::insertion
