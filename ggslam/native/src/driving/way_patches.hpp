// SPDX-License-Identifier: Apache-2.0
// A grid's cells by 64 (4 x 4 x 4 or 8 x 8): those of them that are joined by steps are a patch, and patches are joined
// where a step leads from one to the other.
#pragma once
#include <cstdint>
#include <vector>

#include "driving/way_cost.hpp"
#include "driving/way_grid.hpp"

namespace ggslam::driving {

constexpr int kPatchCells = 64;

struct Patch {
  uint64_t open;       // cells that may be entered, of at least the radius
  Vec3<float> middle;  // of these
  float factor;        // what a cell's length costs in it at least
};

class WayPatches {
 public:
  explicit WayPatches(const WayGrid& grid);

  // What the grid is now, for ways of a cost.
  void begin(const WayCost& cost);

  // Patches are numbered; -1: nothing that may be entered. What a page may still bring is open.
  int64_t number(const Vec3i& cell);
  const Patch& patch(int64_t number) const { return patches_[static_cast<std::size_t>(number)]; }
  std::size_t size() const { return patches_.size(); }
  std::size_t bytes() const {
    return table_.bytes() + blocks_.capacity() * sizeof(Block) + patches_.capacity() * sizeof(Patch);
  }
  // The patches around one that can be reached from it within the 27 times 64 cells, with it.
  void around(int64_t number, std::vector<int64_t>* found);
  // Calls do(number) for the patches of 64 cells.
  template <class Do>
  void for_each(BlockCoordinates at, int index, Do&& visit) {
    for (int32_t row = block(at); row >= 0; row = blocks_[static_cast<std::size_t>(row)].next)
      if (const int64_t n = static_cast<int64_t>(row) * count_ + index; patch(n).open != 0) visit(n);
  }

  int index_of(int32_t cell) const { return index_[static_cast<std::size_t>(cell)]; }  // of a cell of a block
  Vec3i low(int64_t number) const;                              // the first of the 64 cells
  Vec3i cell(int i) const {                                     // one of the 64, from the first
    const int mask = side() - 1;
    return {{i & mask, i >> side_bits_ & mask, i >> (2 * side_bits_)}};
  }
  int side() const { return 1 << side_bits_; }

 private:
  struct Block {
    BlockCoordinates at;
    uint32_t seen, looked;    // in which search, and when all around was
    uint32_t version;         // of the grid's block
    int32_t next;             // holds further patches of the same cells; -1: there are none
    int32_t around[kAround];  // -1: nothing, kUnknown
  };
  int32_t block(BlockCoordinates at);
  int32_t add_block(BlockCoordinates at);
  void look(int32_t row);
  void look(int32_t row, int index, const float* clearance, bool may_come);
  uint64_t part(uint64_t open) const;
  Patch patch_of(const Vec3i& low, uint64_t open, float best) const;
  void look_around(int32_t row);
  const WayGrid& grid_;
  const int side_bits_, per_side_bits_, count_bits_, count_;
  std::vector<uint8_t> index_;
  std::vector<uint16_t> beside_;  // of each patch of a block: number of the block around, patch in it
  uint64_t face_[3];              // cells of a patch's lower face
  int beyond_[3];                 // from a cell of the upper face to that of the lower one
  WayCost cost_{};
  uint32_t search_ = 0;
  std::size_t layout_ = 0;
  BlockTable table_;
  std::vector<int32_t> rows_;  // in `blocks_`, of what is in the table
  std::vector<Block> blocks_;
  std::vector<Patch> patches_;
};

}  // namespace ggslam::driving
