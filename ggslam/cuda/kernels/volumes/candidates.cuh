// SPDX-License-Identifier: Apache-2.0
// Finds the blocks that a view tells about, from large cubes to single blocks, a kernel for each size: the rules of
// native/src/volumes/tsdf_candidates.cpp.
#pragma once
#include "native/formulas/block_sight.hpp"
#include "volumes/depth_images.cuh"

namespace ggslam::cuda {

enum FusedSight : std::int32_t { kSurfaceInSight, kFreeInSight, kPartInSight, kRangeEndsIn };

constexpr int kMostCells = 4096;
constexpr std::uint64_t kKnownFree = std::uint64_t{1} << 63;  // in a cube's key: it lies in a larger one that is free

// The cubes that the search begins with.
struct SearchCells {
  std::int32_t first[3], count[3], side;
  std::int64_t all() const { return static_cast<std::int64_t>(count[0]) * count[1] * count[2]; }
};

// Number of pixels of a tile's or footprint's rectangle that have depth, as a share.
__device__ inline float valid_share(const FuseJob& job, int stride, const Footprint& a) {
  const std::int32_t *top = job.valid + a.v0 * stride, *bottom = job.valid + (a.v1 + 1) * stride;
  const int columns = min((a.u1 + 1) * volumes::kTile, job.width) - a.u0 * volumes::kTile;
  const int rows = min((a.v1 + 1) * volumes::kTile, job.height) - a.v0 * volumes::kTile;
  const int n = bottom[a.u1 + 1] - bottom[a.u0] - top[a.u1 + 1] + top[a.u0];
  return static_cast<float>(n) / (static_cast<float>(columns) * rows);
}

__device__ inline unsigned look_at_pixels(const FuseJob& job, const BlockCamera& camera, int u, int v, float low,
                                          float high) {
  const int x1 = min((u + 1) * volumes::kTile, job.width), y1 = min((v + 1) * volumes::kTile, job.height);
  unsigned seen = 0;
  for (int y = v * volumes::kTile; y < y1; ++y)
    for (int x = u * volumes::kTile; x < x1; ++x)
      seen |= pixel_shows(camera, job.prepared[static_cast<std::int64_t>(y) * job.width + x], low, high);
  return seen;
}

// What tile (u, v) of level `top` shows of a cube: its parts are looked at one after the other, without a stack.
__device__ inline unsigned look(const FuseJob& job, const TilePyramid& pyramid, const BlockCamera& camera, int top,
                                int u, int v, const Footprint& area, const SeenCube& cube) {
  const TileRange* tiles = reinterpret_cast<const TileRange*>(job.tiles);
  unsigned seen = 0;
  for (int level = top;;) {
    bool deeper = false;
    if (u >= area.u0 >> level && u <= area.u1 >> level && v >= area.v0 >> level && v <= area.v1 >> level) {
      const TileRange range = tiles[pyramid.first[level] + static_cast<std::int64_t>(v) * pyramid.width[level] + u];
      bool closer;
      float low = 0, high = 0;
      seen |= tile_shows(camera, level, u, v, range.low, range.high, cube, closer, low, high);
      if (closer && level == 0) seen |= look_at_pixels(job, camera, u, v, low, high);
      if (seen & kSeenAt) return seen;
      deeper = closer && level > 0;
    }
    if (deeper) {
      --level, u *= 2, v *= 2;
      continue;
    }
    for (; level < top && (u & 1) && (v & 1); ++level) u >>= 1, v >>= 1;
    if (level == top) return seen;
    if (u & 1) ++v;
    u ^= 1;
  }
}

// What is seen in a cube's footprint.
__device__ inline unsigned look_at_cube(const FuseJob& job, const TilePyramid& pyramid, const BlockCamera& camera,
                                        const Footprint& area, const SeenCube& cube) {
  int level = 0;  // the coarsest tiles of which the footprint meets few
  while (level < pyramid.levels - 1 && max(area.u1 - area.u0, area.v1 - area.v0) >> level > 2) ++level;
  unsigned seen = 0;
  for (int v = area.v0 >> level; v <= area.v1 >> level && !(seen & kSeenAt); ++v)
    for (int u = area.u0 >> level; u <= area.u1 >> level && !(seen & kSeenAt); ++u)
      seen |= look(job, pyramid, camera, level, u, v, area, cube);
  return seen;
}

// Lists a block, and counts what it will take.
__device__ inline void emit(const FuseJob& job, std::uint64_t key, FusedSight sight, float z) {
  const std::int32_t row = find_row(job.map, key);
  const bool present = row >= 0 && job.map.blocks[row].present != 0;
  const bool dense = present && job.map.blocks[row].slot >= 0;
  if (sight == kRangeEndsIn && !dense) return;             // nothing there to be freed
  if (sight == kPartInSight && present && !dense) return;  // known to be free: needs no voxels to be so in part
  std::int32_t* const counts = job.map.counts;
  const std::int32_t n = atomicAdd(counts + kCandidateCount, 1);
  if (n < job.list_room) job.candidates[n] = {key, z, row, sight};
  if (row < 0) atomicAdd(counts + kNewRows, 1);
  if (sight == kFreeInSight && !dense) return;
  atomicAdd(counts + kUpdateCount, 1);
  if (!dense) atomicAdd(counts + kNewSlots, 1);
}

__device__ inline void push_parts(const FuseJob& job, std::uint64_t key, std::uint64_t mark, int level, int side) {
  const std::int32_t n = atomicAdd(job.map.counts + kLevelCounts + level + 1, 8);
  std::uint64_t* const list = job.cubes + static_cast<std::int64_t>((level + 1) & 1) * job.list_room;
  const int half = side / 2, x = coordinate_of(key, 0), y = coordinate_of(key, 1), z = coordinate_of(key, 2);
  for (int part = 0; part < 8; ++part)
    if (n + part < job.list_room)
      list[n + part] = key_of(x + half * (part & 1), y + half * (part >> 1 & 1), z + half * (part >> 2)) | mark;
}

// Looks at a cube of side^3 blocks.
__device__ inline void look_closer(const FuseJob& job, const TilePyramid& pyramid, const BlockCamera& camera,
                                   std::uint64_t key, int level, int side) {
  const std::uint64_t mark = key & kKnownFree;
  key &= ~kKnownFree;
  const SeenCube cube = seen_cube(camera, coordinate_of(key, 0), coordinate_of(key, 1), coordinate_of(key, 2), side);
  if (mark != 0) {
    if (side == 1) emit(job, key, kFreeInSight, cube.centre[2]);
    else push_parts(job, key, mark, level, side);
    return;
  }
  Footprint area;
  if (!footprint_of(camera, cube, side, area)) return;
  const unsigned seen = look_at_cube(job, pyramid, camera, area, cube);
  if ((seen & (kSeenAt | kSeenBehind | kSeenPassed)) == 0) return;  // no depth, or hidden
  const bool beyond = (seen & kSeenPassed) != 0 || cube.far > camera.max_depth;
  const bool is_free = seen == kSeenBehind && area.whole && !beyond;
  const float share = is_free ? valid_share(job, pyramid.width[0] + 1, area) : 0.0f;
  if (side > 1) {
    push_parts(job, key, share == 1.0f ? kKnownFree : 0, level, side);
    return;
  }
  const bool enough = is_free && share >= camera.free_share;
  emit(job, key, seen & kSeenAt ? kSurfaceInSight : enough ? kFreeInSight : beyond ? kRangeEndsIn : kPartInSight,
       cube.centre[2]);
}

// Looks at all cubes of a level, whose side is `side` blocks.
__global__ void __launch_bounds__(kListThreads, 1)
search_kernel(FuseJob job, TilePyramid pyramid, BlockCamera camera, SearchCells cells, int level, int side) {
  if (is_stopped(job.map)) return;
  const std::int64_t all = static_cast<std::int64_t>(cells.count[0]) * cells.count[1] * cells.count[2];
  const std::int64_t count = level == 0 ? all : min(job.map.counts[kLevelCounts + level], job.list_room);
  const std::uint64_t* const list = job.cubes + static_cast<std::int64_t>(level & 1) * job.list_room;
  for (std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kListThreads + threadIdx.x; i < count;
       i += static_cast<std::int64_t>(gridDim.x) * kListThreads) {
    std::uint64_t key;
    if (level == 0) {
      const int n = static_cast<int>(i), x = n % cells.count[0], y = n / cells.count[0] % cells.count[1];
      const int z = n / cells.count[0] / cells.count[1];
      key = key_of((cells.first[0] + x) * side, (cells.first[1] + y) * side, (cells.first[2] + z) * side);
    } else {
      key = list[i];
    }
    look_closer(job, pyramid, camera, key, level, side);
  }
}

}  // namespace ggslam::cuda
