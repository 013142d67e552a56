// SPDX-License-Identifier: Apache-2.0
// Where the surface of a TSDF runs: cells (cubes between eight voxel centres) with voxels on both sides of it.
#pragma once
#include <cstdint>
#include <vector>

#include "common/dispatch.hpp"
#include "common/thread_pool.hpp"
#include "volumes/tsdf.hpp"

namespace ggslam::volumes {

// One bit for each voxel of a block: bit i + 8 j of word k.
struct BlockBits {
  uint64_t word[kSide];
};

// Which voxels of a block have negative distances, and which are seen often enough to count.
struct BlockSigns {
  BlockBits inside, seen;
};

// Bits of a layer's cells at their lower four corners, x + 2 y.
struct LayerBits {
  uint64_t corner[4];
};

constexpr int kAround = 27;
static constexpr int around_index(int x, int y, int z) { return (x + 1) + 3 * (y + 1) + 9 * (z + 1); }
constexpr int kHere = around_index(0, 0, 0);

// A block that has, or borders on, cells with surface. A cell belongs to the block of its lowest voxel.
struct SurfaceBlock {
  BlockCoordinates at;
  int32_t around[kAround];              // number of the surface block at `around_index`; -1: none there
  const VoxelBlock* voxels[kAround];    // voxels there, never null
  const BlockSigns* upper[kSide];       // signs of the block at x + 2 y + 4 z
  BlockBits cells;                      // those with all corners seen, some inside, some outside

  bool has_cells() const {
    uint64_t any = 0;
    for (uint64_t word : cells.word) any |= word;
    return any != 0;
  }
};

// Finds the blocks that have cells with surface: open addressing, -1 where nothing is.
struct SurfaceTable {
  std::vector<int32_t> number;  // of a surface block, by the hash of its coordinates; a power of two of them

  SurfaceTable() = default;
  explicit SurfaceTable(const std::vector<SurfaceBlock>& blocks);
};

static inline uint32_t surface_hash(int32_t x, int32_t y, int32_t z) {
  const uint32_t h = static_cast<uint32_t>(x) * 0x9E3779B1u + static_cast<uint32_t>(y) * 0x85EBCA77u +
                     static_cast<uint32_t>(z) * 0xC2B2AE3Du;
  return h ^ h >> 15;
}

class SurfaceCells {
 public:
  // The map must outlive this and stay as it is.
  SurfaceCells(ThreadPool& pool, Isa isa, const Tsdf& map, uint16_t min_weight);

  const Tsdf& map;
  const uint16_t min_weight;  // voxels of at least this weight count
  std::vector<SurfaceBlock> blocks;
  SurfaceTable table;

  // Layer k of a block, k <= 8: bits of `which` at the lower corners of its cells.
  static LayerBits layer(const SurfaceBlock& block, int k, BlockBits BlockSigns::*which);

 private:
  std::vector<BlockSigns> signs_;  // by the map's row

  std::vector<int32_t> active_rows(ThreadPool& pool, Isa isa);
  void connect(SurfaceBlock& block, const std::vector<int32_t>& number) const;
};

}  // namespace ggslam::volumes
