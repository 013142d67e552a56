// SPDX-License-Identifier: Apache-2.0
// Log-odds of occupancy on OctoMap's key grid: an octree whose lowest three levels are dense blocks of 8^3 voxels. A
// part of space that has one value throughout is one leaf, of any size, so that large free leaves of a file and blocks
// that are sure to be free cost nothing.
#pragma once
#include <cstdint>
#include <memory>
#include <vector>

#include "volumes/occupancy_keys.hpp"

namespace ggslam {

enum class CellKind : std::uint32_t { unknown = 0, leaf = 1, node = 2, block = 3 };

struct Cell {
  CellKind kind = CellKind::unknown;
  std::uint32_t index = 0;  // of a node or block
  float value = 0;          // of a leaf
};

struct OccupancyNode {
  Cell child[8];
};

// Voxels in Morton order. Voxels that are not known have the value 0, where OctoMap starts, too.
struct alignas(64) OccupancyBlock {
  float value[kBlockVoxels];
  std::uint64_t known[kBlockVoxels / 64];
};

// Objects at places that never move, taken again after use.
template <class T>
class Pool {
 public:
  T& operator[](std::uint32_t i) { return chunks_[i / kChunk][i % kChunk]; }
  const T& operator[](std::uint32_t i) const { return chunks_[i / kChunk][i % kChunk]; }
  std::uint32_t take() {
    if (!free_.empty()) {
      const std::uint32_t i = free_.back();
      free_.pop_back();
      return i;
    }
    if (taken_ / kChunk == chunks_.size()) chunks_.emplace_back(new T[kChunk]);
    return taken_++;
  }
  void give_back(std::uint32_t i) { free_.push_back(i); }
  std::size_t used() const { return taken_ - free_.size(); }
  std::size_t bytes() const { return chunks_.size() * kChunk * sizeof(T) + free_.capacity() * sizeof(std::uint32_t); }

 private:
  static constexpr std::uint32_t kChunk = 256;
  std::vector<std::unique_ptr<T[]>> chunks_;
  std::vector<std::uint32_t> free_;
  std::uint32_t taken_ = 0;
};

class OccupancyTree {
 public:
  explicit OccupancyTree(double resolution) : grid(resolution) {}

  KeyGrid grid;
  Cell root;
  Pool<OccupancyNode> nodes;
  Pool<OccupancyBlock> blocks;

  // The cell that holds a block: a block, or a leaf of that size or larger, or unknown.
  Cell find(std::uint64_t block_code) const;
  // The block itself, made where it is unknown, taken out of its leaf where it is part of one.
  OccupancyBlock& open(std::uint64_t block_code);
  // Makes a leaf of a block that is known throughout and of one value, and of those above it that then are.
  void collapse(std::uint64_t block_code);
  void clear();

  // Makes cells of the parts, for building from a file; collapsed where they can be.
  Cell make_block(const OccupancyBlock& content);
  Cell make_node(const Cell child[8]);

 private:
  void split(Cell& cell);
  void fold(Cell& cell);
};

// The child that leads to a block from the node at `depth`.
static inline int child_of_block(std::uint64_t block_code, int depth) {
  return static_cast<int>(block_code >> (3 * (kBlockDepth - 1 - depth))) & 7;
}

}  // namespace ggslam
