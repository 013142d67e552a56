// SPDX-License-Identifier: Apache-2.0
#include "volumes/surface_cells.hpp"

#include <algorithm>
#include <atomic>

GGSLAM_DECLARE_KERNEL(bool block_signs(const volumes::VoxelBlock& voxels, uint16_t min_weight,
                                       volumes::BlockSigns* out))

namespace ggslam::volumes {
namespace {

constexpr std::size_t kChunkOfBlocks = 64;
constexpr uint64_t kFirstColumn = 0x0101010101010101ull;

// What stands for blocks without voxels.
struct PlainBlocks {
  VoxelBlock free, unseen;
  BlockSigns unseen_signs{};
  PlainBlocks() : free(), unseen() {
    std::fill_n(free.value, kVoxels, kFreeValue);
    std::fill_n(free.weight, kVoxels, kFullWeight);
    std::fill_n(unseen.value, kVoxels, kFreeValue);
  }
};

const PlainBlocks& plain() {
  static const PlainBlocks blocks;
  return blocks;
}

// Each voxel's upper neighbour along x or y, given the layer and that of the next block.
uint64_t next_x(uint64_t here, uint64_t beyond) {
  return ((here >> 1) & ~(kFirstColumn << 7)) | (beyond & kFirstColumn) << 7;
}
uint64_t next_y(uint64_t here, uint64_t beyond) { return here >> 8 | beyond << 56; }

void find_cells(SurfaceBlock& block) {
  LayerBits inside = SurfaceCells::layer(block, 0, &BlockSigns::inside);
  LayerBits seen = SurfaceCells::layer(block, 0, &BlockSigns::seen);
  for (int k = 0; k < kSide; ++k) {
    const LayerBits above = SurfaceCells::layer(block, k + 1, &BlockSigns::inside);
    const LayerBits seen_above = SurfaceCells::layer(block, k + 1, &BlockSigns::seen);
    uint64_t any = 0, all = ~0ull, known = ~0ull;
    for (int c = 0; c < 4; ++c) {
      any |= inside.corner[c] | above.corner[c];
      all &= inside.corner[c] & above.corner[c];
      known &= seen.corner[c] & seen_above.corner[c];
    }
    block.cells.word[k] = known & any & ~all;
    inside = above, seen = seen_above;
  }
}

}  // namespace

LayerBits SurfaceCells::layer(const SurfaceBlock& block, int k, BlockBits BlockSigns::*which) {
  uint64_t l[4];
  for (int c = 0; c < 4; ++c)
    l[c] = k < kSide ? (block.upper[c]->*which).word[k] : (block.upper[c + 4]->*which).word[0];
  const uint64_t up = next_y(l[0], l[2]);
  return {{l[0], next_x(l[0], l[1]), up, next_x(up, next_y(l[1], l[3]))}};
}

// Signs of all blocks; returns the rows of those whose cells or edges may hold surface: a block with a voxel inside
// and the seven below it.
std::vector<int32_t> SurfaceCells::active_rows(ThreadPool& pool, Isa isa) {
  const auto kernel = GGSLAM_DISPATCH(isa, block_signs);
  signs_.resize(map.size());
  std::vector<std::atomic<uint8_t>> active(map.size());
  pool.parallel_for(map.size(), kChunkOfBlocks, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t row = begin; row < end; ++row) {
      const Block& b = map.block(row);
      const VoxelBlock* voxels = map.voxels(b);
      if (voxels == nullptr) {
        signs_[row] = BlockSigns{};
        if (b.free_weight >= min_weight) std::fill_n(signs_[row].seen.word, kSide, ~0ull);
        continue;
      }
      if (!kernel(*voxels, min_weight, &signs_[row])) continue;
      for (int c = 0; c < 8; ++c) {
        const int64_t below = map.find({b.at.x - (c & 1), b.at.y - ((c >> 1) & 1), b.at.z - (c >> 2)});
        if (below >= 0) active[below].store(1, std::memory_order_relaxed);
      }
    }
  });
  std::vector<int32_t> rows;
  for (std::size_t row = 0; row < map.size(); ++row)
    if (active[row].load(std::memory_order_relaxed)) rows.push_back(static_cast<int32_t>(row));
  return rows;
}

// Finds the blocks around one; `number` gives the surface block of a row, -1 if it is none.
void SurfaceCells::connect(SurfaceBlock& block, const std::vector<int32_t>& number) const {
  for (int z = -1; z <= 1; ++z)
    for (int y = -1; y <= 1; ++y)
      for (int x = -1; x <= 1; ++x) {
        const int64_t row = map.find({block.at.x + x, block.at.y + y, block.at.z + z});
        const int index = around_index(x, y, z);
        block.around[index] = row < 0 ? -1 : number[row];
        const Block* b = row < 0 ? nullptr : &map.block(row);
        const VoxelBlock* voxels = b ? map.voxels(*b) : nullptr;
        block.voxels[index] = voxels                                    ? voxels
                              : b != nullptr && b->free_weight >= min_weight ? &plain().free
                                                                             : &plain().unseen;
        if (x >= 0 && y >= 0 && z >= 0) block.upper[x + 2 * y + 4 * z] = b ? &signs_[row] : &plain().unseen_signs;
      }
}

SurfaceTable::SurfaceTable(const std::vector<SurfaceBlock>& blocks) {
  std::size_t size = 64;
  while (size < 4 * blocks.size()) size *= 2;  // most look-ups find nothing, and at once
  number.assign(size, -1);
  for (std::size_t n = 0; n < blocks.size(); ++n) {
    if (!blocks[n].has_cells()) continue;
    std::size_t p = surface_hash(blocks[n].at.x, blocks[n].at.y, blocks[n].at.z) & (size - 1);
    while (number[p] >= 0) p = (p + 1) & (size - 1);
    number[p] = static_cast<int32_t>(n);
  }
}

SurfaceCells::SurfaceCells(ThreadPool& pool, Isa isa, const Tsdf& map_, uint16_t min_weight_)
    : map(map_), min_weight(std::max<uint16_t>(min_weight_, 1)) {
  const std::vector<int32_t> rows = active_rows(pool, isa);
  std::vector<int32_t> number(map.size(), -1);
  for (std::size_t n = 0; n < rows.size(); ++n) number[rows[n]] = static_cast<int32_t>(n);
  blocks.resize(rows.size());
  pool.parallel_for(rows.size(), kChunkOfBlocks, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t n = begin; n < end; ++n) {
      blocks[n].at = map.block(rows[n]).at;
      connect(blocks[n], number);
      find_cells(blocks[n]);
    }
  });
  table = SurfaceTable(blocks);
}

}  // namespace ggslam::volumes
