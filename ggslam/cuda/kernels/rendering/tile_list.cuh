// SPDX-License-Identifier: Apache-2.0
// Counts or writes the tiles that the splats of one warp reach. Most splats lie in one to four tiles, which their own
// lane goes through; the tiles of a large one are shared out over the whole warp, so that it holds nobody up.
#pragma once
#include "rendering/workspace.cuh"

namespace ggslam::cuda {

constexpr int kSmallArea = 8;  // tiles of a bounding box that one lane goes through alone

__device__ inline bool reaches_tile(const Splat& s, int tile_x, int tile_y) {
  return reaches(s, static_cast<float>(tile_x * kTileSize), static_cast<float>(tile_y * kTileSize), kTileSize - 1,
                 kTileSize - 1);
}

__device__ inline Splat splat_of_lane(const Splat& mine, int lane) {
  Splat s = {};
  s.mean_x = __shfl_sync(kAllLanes, mine.mean_x, lane), s.mean_y = __shfl_sync(kAllLanes, mine.mean_y, lane);
  s.conic_r = __shfl_sync(kAllLanes, mine.conic_r, lane), s.conic_y = __shfl_sync(kAllLanes, mine.conic_y, lane);
  s.log2_opacity = __shfl_sync(kAllLanes, mine.log2_opacity, lane);
  s.slope_x = __shfl_sync(kAllLanes, mine.slope_x, lane), s.slope_y = __shfl_sync(kAllLanes, mine.slope_y, lane);
  return s;
}

__device__ inline TileRectangle rectangle_of_lane(const TileRectangle& mine, int lane) {
  const unsigned corner = __shfl_sync(kAllLanes, mine.x | static_cast<unsigned>(mine.y) << 16, lane);
  const unsigned size = __shfl_sync(kAllLanes, mine.wide | static_cast<unsigned>(mine.high) << 16, lane);
  return {static_cast<std::uint16_t>(corner), static_cast<std::uint16_t>(corner >> 16),
          static_cast<std::uint16_t>(size), static_cast<std::uint16_t>(size >> 16)};
}

// Calls visit(row, place, tile) for each tile that a splat reaches, with place = first, first + 1 and so on, and returns
// how many tiles the calling lane's splat reaches. All lanes of a warp must call this; a lane without a splat gives an
// empty rectangle.
template <class Visit>
__device__ inline unsigned visit_reached_tiles(const Splat& mine, const TileRectangle& rectangle, int tiles_x,
                                               unsigned row, unsigned first, const Visit& visit) {
  const int lane = threadIdx.x % kWarp;
  const int area = rectangle.wide * rectangle.high;
  unsigned count = 0;
  if (area <= kSmallArea)
    for (int y = rectangle.y; y < rectangle.y + rectangle.high; ++y)
      for (int x = rectangle.x; x < rectangle.x + rectangle.wide; ++x)
        if (reaches_tile(mine, x, y)) visit(row, first + count++, y * tiles_x + x);
  for (unsigned large = __ballot_sync(kAllLanes, area > kSmallArea); large != 0; large &= large - 1) {
    const int owner = __ffs(static_cast<int>(large)) - 1;
    const Splat s = splat_of_lane(mine, owner);
    const TileRectangle r = rectangle_of_lane(rectangle, owner);
    const unsigned owners_row = __shfl_sync(kAllLanes, row, owner), owners_first = __shfl_sync(kAllLanes, first, owner);
    const int tiles = r.wide * r.high;
    unsigned found = 0;
    for (int begin = 0; begin < tiles; begin += kWarp) {
      const int i = begin + lane, x = r.x + i % r.wide, y = r.y + i / r.wide;
      const bool here = i < tiles && reaches_tile(s, x, y);
      const unsigned lanes = __ballot_sync(kAllLanes, here);
      if (here) visit(owners_row, owners_first + found + __popc(lanes & ((1u << lane) - 1)), y * tiles_x + x);
      found += __popc(lanes);
    }
    if (lane == owner) count = found;
  }
  return count;
}

}  // namespace ggslam::cuda
