// SPDX-License-Identifier: Apache-2.0
// Rows of blocks found by their coordinates: open addressing, linear probing.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "common/box.hpp"

namespace ggslam::volumes {

struct BlockCoordinates {
  int32_t x, y, z;
};

// Coordinates of blocks lie within this: those of their voxels, and of what is around them, are integers of 32 bits.
constexpr int32_t kFarthestBlock = 1 << 27;

static inline Vec3i vector_of(BlockCoordinates at) { return {{at.x, at.y, at.z}}; }
static inline Box3i box_of(BlockCoordinates at) { return Box3i::at(vector_of(at)); }

// What a look-up reads. Kernels look up, too, hence the functions are static: each instruction set has its own copy.
struct TableView {
  const int32_t* rows;  // -1: empty
  std::size_t mask;
  const BlockCoordinates* at;  // by row
};

static inline std::size_t block_hash(BlockCoordinates at) {
  uint64_t h = static_cast<uint32_t>(at.x) * 0x9E3779B97F4A7C15ull;
  h = (h ^ (h >> 29)) + static_cast<uint32_t>(at.y) * 0xBF58476D1CE4E5B9ull;
  h = (h ^ (h >> 31)) + static_cast<uint32_t>(at.z) * 0x94D049BB133111EBull;
  return static_cast<std::size_t>(h ^ (h >> 32));
}

// Where a block stands in the table, or the empty place where it would.
static inline std::size_t block_place(const TableView& t, BlockCoordinates at) {
  std::size_t p = block_hash(at) & t.mask;
  for (; t.rows[p] >= 0; p = (p + 1) & t.mask) {
    const BlockCoordinates& b = t.at[t.rows[p]];
    if (b.x == at.x && b.y == at.y && b.z == at.z) break;
  }
  return p;
}

static inline int32_t block_row(const TableView& t, BlockCoordinates at) { return t.rows[block_place(t, at)]; }

class BlockTable {
 public:
  BlockTable() { clear(); }
  std::size_t size() const { return at_.size(); }
  BlockCoordinates at(std::size_t row) const { return at_[row]; }
  TableView view() const { return {rows_.data(), rows_.size() - 1, at_.data()}; }
  int32_t find(BlockCoordinates at) const { return block_row(view(), at); }
  // Row of a block; a new one is the last.
  std::size_t insert(BlockCoordinates at);
  // The last block takes the row of the erased one.
  void erase(std::size_t row);
  void clear();
  std::size_t bytes() const { return rows_.capacity() * sizeof(int32_t) + at_.capacity() * sizeof(BlockCoordinates); }

 private:
  std::vector<int32_t> rows_;
  std::vector<BlockCoordinates> at_;
};

}  // namespace ggslam::volumes
