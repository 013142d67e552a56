// SPDX-License-Identifier: Apache-2.0
// Lists of splats per tile, nearest first. Gaussians are sorted by depth once; (tile, row) pairs are then written in
// that order, and a stable sort by tile alone keeps it. That moves far fewer bytes than sorting pairs by tile and depth.
#pragma once
#include "rendering/tile_list.cuh"

namespace ggslam::cuda {

constexpr int kBinThreads = 256;

// counts_by_depth[i]: tiles of the i-th nearest Gaussian.
__global__ void __launch_bounds__(kBinThreads) gather_counts_kernel(std::int64_t count, GaussianWorkspace w) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kBinThreads + threadIdx.x;
  if (i < count) w.counts_by_depth[i] = w.tile_counts[w.rows_by_depth[i]];
}

// Pairs that find no room are dropped: the host learns the true number and starts again with more room.
__global__ void __launch_bounds__(kBinThreads)
write_pairs_kernel(std::int64_t count, Grid grid, GaussianWorkspace w, PairWorkspace pairs, std::uint32_t capacity) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kBinThreads + threadIdx.x;
  std::uint32_t row = 0, number = 0, first = 0;
  Splat splat = {};
  TileRectangle rectangle = {};
  if (i < count) number = w.counts_by_depth[i];
  if (number > 0) {
    first = w.pair_ends[i] - number;
    row = w.rows_by_depth[i];
    splat = w.splats[row];
    rectangle = w.rectangles[row];
  }
  visit_reached_tiles(splat, rectangle, grid.tiles_x, row, first, [&](unsigned of, unsigned place, int tile) {
    if (place >= capacity) return;
    pairs.tiles[place] = static_cast<std::uint32_t>(tile);
    pairs.rows[place] = of;
  });
}

// tile_start[t]: first pair of tile t or, if it has none, of the next tile that has. Places that no pair was written to
// hold a tile number beyond the last tile. One thread more than there are pairs.
__global__ void __launch_bounds__(kBinThreads)
tile_starts_kernel(std::uint32_t capacity, const std::uint32_t* sorted_tiles, int tiles, std::uint32_t* tile_start) {
  const std::uint32_t i = blockIdx.x * static_cast<std::uint32_t>(kBinThreads) + threadIdx.x;
  if (i > capacity) return;
  const auto tile_of = [&](std::uint32_t place) {
    const std::uint32_t tile = sorted_tiles[place];
    return tile < static_cast<std::uint32_t>(tiles) ? static_cast<int>(tile) : tiles;
  };
  const int before = i == 0 ? -1 : tile_of(i - 1), here = i == capacity ? tiles : tile_of(i);
  for (int tile = before + 1; tile <= here; ++tile) tile_start[tile] = i;
}

}  // namespace ggslam::cuda
