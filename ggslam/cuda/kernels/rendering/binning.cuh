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

// Pairs that find no room, those of the farthest Gaussians, are dropped: either the host waits for the true number and
// starts again with more room, or the rendering cannot be differentiated (see load_pixel).
__global__ void __launch_bounds__(kBinThreads)
write_pairs_kernel(std::int64_t count, Grid grid, GaussianWorkspace w, PairWorkspace pairs) {
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
    if (place >= pairs.capacity) return;
    pairs.tiles[place] = static_cast<std::uint32_t>(tile);
    pairs.rows[place] = of;
  });
}

// Where it is told whether a rendering found room for its pairs, see Rendering.
struct RoomReport {
  std::int32_t* overflowed;
  std::int64_t* overflows;
  std::int64_t* most_pairs;
};

// tile_start[t]: first pair of tile t or, if it has none, of the next tile that has. Places that no pair was written to
// hold a tile number beyond the last tile. One thread more than there are pairs.
__global__ void __launch_bounds__(kBinThreads)
tile_starts_kernel(GaussianWorkspace w, PairWorkspace pairs, int tiles, std::uint32_t* tile_start, RoomReport report) {
  const std::uint32_t i = blockIdx.x * static_cast<std::uint32_t>(kBinThreads) + threadIdx.x;
  if (i == 0) {
    const bool overflowed = out_of_room(w, pairs);
    *report.overflowed = overflowed ? 1 : 0;
    if (overflowed && report.overflows != nullptr) ++*report.overflows;
    const std::int64_t found = static_cast<std::int64_t>(w.totals->pairs);
    if (report.most_pairs != nullptr && found > *report.most_pairs) *report.most_pairs = found;
  }
  if (i > pairs.capacity) return;
  const auto tile_of = [&](std::uint32_t place) {
    const std::uint32_t tile = pairs.sorted_tiles[place];
    return tile < static_cast<std::uint32_t>(tiles) ? static_cast<int>(tile) : tiles;
  };
  const int before = i == 0 ? -1 : tile_of(i - 1), here = i == pairs.capacity ? tiles : tile_of(i);
  for (int tile = before + 1; tile <= here; ++tile) tile_start[tile] = i;
}

}  // namespace ggslam::cuda
