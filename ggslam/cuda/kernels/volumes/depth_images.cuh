// SPDX-License-Identifier: Apache-2.0
// Prepares the images of a view: depth with 0 for none, the smallest depth around each pixel, and the range of depth in
// tiles of 4 pixels, of twice as many, and so on. What the numbers mean is stated in native/src/volumes/tsdf_fusion.hpp.
#pragma once
#include "volumes/fused_map.cuh"

namespace ggslam::cuda {

constexpr int kPixelThreads = 256, kTotalThreads = 1024;
constexpr int kMostPyramid = 16;

// Tiles of all sizes; `first`: of a level, in tiles.
struct TilePyramid {
  int levels;
  int width[kMostPyramid], height[kMostPyramid];
  std::int64_t first[kMostPyramid + 1];
};

struct TileRange {
  float low, high;  // (infinity, 0) where there is no depth
};

inline TilePyramid pyramid_of(int width, int height) {
  TilePyramid p{};
  int wide = (width + volumes::kTile - 1) / volumes::kTile, high = (height + volumes::kTile - 1) / volumes::kTile;
  for (;;) {
    p.width[p.levels] = wide, p.height[p.levels] = high;
    p.first[p.levels + 1] = p.first[p.levels] + static_cast<std::int64_t>(wide) * high;
    ++p.levels;
    if ((wide == 1 && high == 1) || p.levels == kMostPyramid) return p;
    wide = (wide + 1) / 2, high = (high + 1) / 2;
  }
}

// Copies depth, a thread for each tile. What lies beyond the range (+inf included: the sensor found nothing) is cut off two
// truncations behind it. The first block begins the operation: it sets its counts to 0.
__global__ void __launch_bounds__(kPixelThreads) prepare_depth_kernel(FuseJob job, TilePyramid pyramid) {
  if (is_stopped(job.map)) return;
  if (blockIdx.x == 0 && threadIdx.x >= kCandidateCount && threadIdx.x < kFusedCounts) job.map.counts[threadIdx.x] = 0;
  const std::int64_t tile = static_cast<std::int64_t>(blockIdx.x) * kPixelThreads + threadIdx.x;
  const int wide = pyramid.width[0];
  if (tile >= pyramid.first[1]) return;
  const int column = static_cast<int>(tile % wide), row = static_cast<int>(tile / wide);
  const float farthest = job.settings.max_depth + 2 * job.map.truncation;
  const int x1 = min((column + 1) * volumes::kTile, job.width), y1 = min((row + 1) * volumes::kTile, job.height);
  float low = INFINITY, high = 0.0f;
  int count = 0;
  for (int y = row * volumes::kTile; y < y1; ++y)
    for (int x = column * volumes::kTile; x < x1; ++x) {
      const std::int64_t pixel = static_cast<std::int64_t>(y) * job.width + x;
      float z = job.depth[pixel];
      if (job.cut_beyond != 0 && z > job.settings.max_depth) z = 0.0f;
      z = z >= job.settings.min_depth ? minimum(z, farthest) : 0.0f;
      job.prepared[pixel] = z;
      if (!(z > 0)) continue;
      low = minimum(low, z), high = maximum(high, z);
      ++count;
    }
  reinterpret_cast<TileRange*>(job.tiles)[tile] = {low, high};
  job.valid[(row + 1) * (wide + 1) + column + 1] = count;
}

// Smallest depth around each pixel; infinite where there is none.
__global__ void __launch_bounds__(kPixelThreads) erode_kernel(FuseJob job) {
  const std::int64_t pixel = static_cast<std::int64_t>(blockIdx.x) * kPixelThreads + threadIdx.x;
  if (pixel >= static_cast<std::int64_t>(job.height) * job.width || is_stopped(job.map)) return;
  const int x = static_cast<int>(pixel % job.width), y = static_cast<int>(pixel / job.width);
  constexpr int kReach = volumes::kErosion;
  float low = INFINITY;
  for (int v = max(y - kReach, 0); v <= min(y + kReach, job.height - 1); ++v)
    for (int u = max(x - kReach, 0); u <= min(x + kReach, job.width - 1); ++u) {
      const float z = job.prepared[static_cast<std::int64_t>(v) * job.width + u];
      if (z > 0) low = minimum(low, z);
    }
  job.eroded[pixel] = low;
}

// Sums the numbers of pixels with depth from the upper left: along the rows by warps, then along the columns.
__device__ inline void sum_valid(std::int32_t* valid, int wide, int high) {
  const int stride = wide + 1, lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  for (int x = threadIdx.x; x < stride; x += kTotalThreads) valid[x] = 0;
  for (int y = 1 + warp; y <= high; y += kTotalThreads / kWarp) {
    std::int32_t before = 0;
    if (lane == 0) valid[y * stride] = 0;
    for (int first = 1; first <= wide; first += kWarp) {
      const int x = first + lane;
      std::int32_t sum = x <= wide ? valid[y * stride + x] : 0;
      for (int step = 1; step < kWarp; step *= 2) {
        const std::int32_t other = __shfl_sync(kAllLanes, sum, (lane - step) & (kWarp - 1));
        if (lane >= step) sum += other;
      }
      if (x <= wide) valid[y * stride + x] = sum + before;
      before += __shfl_sync(kAllLanes, sum, kWarp - 1);
    }
  }
  __syncthreads();
  for (int x = 1 + threadIdx.x; x <= wide; x += kTotalThreads) {
    std::int32_t sum = 0;
    for (int y = 1; y <= high; ++y) valid[y * stride + x] = sum += valid[y * stride + x];
  }
}

// The larger tiles, and the sums of pixels with depth. One block.
__global__ void __launch_bounds__(kTotalThreads) finish_tiles_kernel(FuseJob job, TilePyramid pyramid) {
  if (is_stopped(job.map)) return;
  TileRange* const tiles = reinterpret_cast<TileRange*>(job.tiles);
  for (int level = 1; level < pyramid.levels; ++level) {
    const TileRange* fine = tiles + pyramid.first[level - 1];
    const int wide = pyramid.width[level], fine_wide = pyramid.width[level - 1], fine_high = pyramid.height[level - 1];
    for (int t = threadIdx.x; t < wide * pyramid.height[level]; t += kTotalThreads) {
      TileRange range{INFINITY, 0.0f};
      for (int part = 0; part < 4; ++part) {
        const int x = 2 * (t % wide) + (part & 1), y = 2 * (t / wide) + (part >> 1);
        if (x >= fine_wide || y >= fine_high) continue;
        const TileRange from = fine[static_cast<std::int64_t>(y) * fine_wide + x];
        range.low = minimum(range.low, from.low), range.high = maximum(range.high, from.high);
      }
      tiles[pyramid.first[level] + t] = range;
    }
    __syncthreads();
  }
  sum_valid(job.valid, pyramid.width[0], pyramid.height[0]);
}

}  // namespace ggslam::cuda
