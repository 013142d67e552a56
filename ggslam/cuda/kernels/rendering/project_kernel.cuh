// SPDX-License-Identifier: Apache-2.0
// From Gaussians to splats: project, drop what cannot be seen, count the tiles that each one reaches.
#pragma once
#include "rendering/tile_list.cuh"
#include "rendering/view_colour.cuh"

namespace ggslam::cuda {

constexpr int kProjectThreads = 256;

// Tiles from first to last that the pixels within `extent` of `centre` fall in; false where there is no pixel.
__device__ inline bool tile_range(float centre, float extent, int size, int& first, int& last) {
  const float limit = static_cast<float>(size - 1);
  const float low = fmaxf(centre - extent, 0.0f), high = fminf(centre + extent, limit);
  if (!(high >= 0.0f && low <= limit)) return false;
  const int first_pixel = static_cast<int>(ceilf(low)), last_pixel = static_cast<int>(floorf(high));
  first = first_pixel / kTileSize, last = last_pixel / kTileSize;
  return first_pixel <= last_pixel;
}

// Fills splat and rectangle; false if nothing of the Gaussian can be seen.
__device__ inline bool make_splat(const GaussianArrays& arrays, const ViewConstants& c, const Grid& grid,
                                  std::int64_t row, Splat& splat, TileRectangle& rectangle) {
  const RawGaussian g = load_gaussian(arrays, row);
  const Projection p = project(c, g);
  splat.log2_opacity = -log2f(1.0f + exp2f(-kLog2E * g.opacity_logit));
  if (!renderable(c, g, p) || !(splat.log2_opacity >= kLog2MinAlpha)) return false;
  // alpha >= 1/255 inside the ellipse d^T cov^-1 d <= 2 ln(255 opacity); a hair larger, so that rounding here never
  // decides which pixels are in.
  const float radius2 = 2.0f * kLn2 * (splat.log2_opacity - kLog2MinAlpha) + 2e-3f;
  splat.mean_x = c.fx * p.u + c.cx, splat.mean_y = c.fy * p.v + c.cy;
  int x0, x1, y0, y1;
  if (!tile_range(splat.mean_x, sqrtf(radius2 * p.cov_xx), grid.width, x0, x1)) return false;
  if (!tile_range(splat.mean_y, sqrtf(radius2 * p.cov_yy), grid.height, y0, y1)) return false;
  rectangle = {static_cast<std::uint16_t>(x0), static_cast<std::uint16_t>(y0), static_cast<std::uint16_t>(x1 - x0 + 1),
               static_cast<std::uint16_t>(y1 - y0 + 1)};
  float colour[3];
  view_colour(arrays, c, row, p.position, colour);
  if (!(fabsf(colour[0]) + fabsf(colour[1]) + fabsf(colour[2]) <= kFinite)) return false;
  splat.red = fmaxf(colour[0], 0.0f), splat.green = fmaxf(colour[1], 0.0f), splat.blue = fmaxf(colour[2], 0.0f);
  splat.conic_r = -0.5f * kLog2E * p.conic_r, splat.conic_y = -0.5f * kLog2E * p.conic_y;
  splat.slope_x = p.slope, splat.slope_y = p.cov_xy / p.cov_xx;
  splat.depth = p.position[2];
  return true;
}

// Adds a block's numbers to the totals by one thread.
__device__ inline void add_totals(Totals* totals, bool visible, unsigned pairs) {
  GGSLAM_SHARED unsigned long long sums[kProjectThreads / kWarp];
  const unsigned in_warp = __reduce_add_sync(kAllLanes, pairs);
  if (threadIdx.x % kWarp == 0) sums[threadIdx.x / kWarp] = in_warp;
  const int visible_in_block = __syncthreads_count(visible);
  if (threadIdx.x != 0 || visible_in_block == 0) return;
  unsigned long long all = 0;
  for (unsigned long long sum : sums) all += sum;
  atomicAdd(&totals->visible, static_cast<unsigned long long>(visible_in_block));
  atomicAdd(&totals->pairs, all);
}

// first_depth: bits of the near plane as a float. Keys are the bits of the depth above it, which are ordered like the
// depth; Gaussians that are not visible get `hidden`, larger than any depth's key.
__global__ void __launch_bounds__(kProjectThreads)
project_kernel(GaussianArrays arrays, ViewConstants c, const float* pose, Grid grid, std::uint32_t first_depth,
               std::uint32_t hidden, GaussianWorkspace w) {
  read_pose(pose, c);
  const std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * kProjectThreads + threadIdx.x;
  Splat splat = {};
  TileRectangle rectangle = {};
  bool visible = row < arrays.count && make_splat(arrays, c, grid, row, splat, rectangle);
  if (!visible) rectangle = {};
  const unsigned pairs = visit_reached_tiles(splat, rectangle, grid.tiles_x, 0, 0, [](unsigned, unsigned, int) {});
  visible = pairs > 0;
  if (row < arrays.count) {
    w.tile_counts[row] = pairs;
    w.rows[row] = static_cast<std::uint32_t>(row);
    w.depth_keys[row] = visible ? __float_as_uint(splat.depth) - first_depth : hidden;
    if (visible) {
      w.splats[row] = splat;
      w.rectangles[row] = rectangle;
    }
  }
  add_totals(w.totals, visible, pairs);
}

}  // namespace ggslam::cuda
