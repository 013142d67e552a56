// SPDX-License-Identifier: Apache-2.0
// Cells that know how far the nearest obstacle is, in blocks that know their neighbours. Lengths and places are in
// cells; the centre of a cell is at whole numbers.
#pragma once
#include <cstdint>
#include <memory>
#include <unordered_set>
#include <vector>

#include "common/vector.hpp"
#include "volumes/block_table.hpp"

namespace ggslam::driving {

using volumes::BlockCoordinates;
using volumes::BlockTable;

constexpr int kHere = 13;       // a cell among the 27 around it: 13 + x + 3 y + 9 z
constexpr int kAround = 27;
constexpr uint8_t kNoStep = 255;
constexpr int kIndexBits = 10;  // of a cell's number in its block
constexpr int64_t kFarthestCell = int64_t{1} << 29;

// What a search knows of a cell.
struct WayNode {
  float value;   // cost from the start; of the widest way, the least clearance on it
  uint8_t step;  // the neighbour's number of this cell where it was reached from; kNoStep: at the start
  uint8_t done;  // its neighbours were looked at
};

struct WayBlock {
  int32_t around[kAround];             // rows of the blocks around; -1: not there
  std::unique_ptr<float[]> clearance;  // NaN: may not be entered
  std::unique_ptr<WayNode[]> nodes;
  uint32_t search = 0;  // which search the nodes are of
  std::unique_ptr<float[]> ahead;  // what the way to the goal costs at least, as earlier searches know
  uint32_t goal = 0;               // which goal that is
  uint32_t version = 0;            // of the clearances
  std::unique_ptr<float[]> guide;  // see WayGuide
  uint32_t guided[16] = {};        // by patch: of which guide
};

// Where a cell is.
struct CellPlace {
  int32_t row;  // -1: nowhere
  int32_t index;
};

struct PageHash {
  std::size_t operator()(const BlockCoordinates& at) const { return volumes::block_hash(at); }
};
struct SamePage {
  bool operator()(const BlockCoordinates& a, const BlockCoordinates& b) const {
    return a.x == b.x && a.y == b.y && a.z == b.z;
  }
};

class WayGrid {
 public:
  WayGrid(int dimensions, double cell, int page);

  const int dimensions;
  const double cell;  // metres
  const int page;     // blocks; 0: all is written
  const int bits[3];  // of a cell's place in its block
  const int cells;    // of a block

  // Searches are numbered. What one for a goal found out serves the next one for the same goal, as long as nothing got
  // cheaper: the goal is as far from a cell as the whole way is long, less the way to the cell (adaptive A*).
  void begin_search(bool same_goal);
  void end_search(float cost) { costs_.back() = cost; }  // infinite: the goal cannot be reached
  void forget() { forgotten_ = true; }

  void write(const Vec3i& low, const Vec3i& shape, const float* clearance);
  void read(const Vec3i& low, const Vec3i& shape, float* clearance) const;
  void finish_page(BlockCoordinates at) { finished_.insert(at); }
  // Another number whenever a block has come that was not to come any more.
  std::size_t layout() const { return layout_; }
  std::size_t bytes() const;

  // Whether a block that is not there may still come.
  bool may_come(BlockCoordinates at) const { return page != 0 && finished_.count(page_of(at)) == 0; }
  BlockCoordinates page_of(BlockCoordinates at) const;

  std::size_t size() const { return blocks_.size(); }
  WayBlock& block(int32_t row) { return blocks_[static_cast<std::size_t>(row)]; }
  const WayBlock& block(int32_t row) const { return blocks_[static_cast<std::size_t>(row)]; }
  int32_t row(BlockCoordinates at) const { return table_.find(at); }  // -1: not there
  BlockCoordinates at(int32_t row) const { return table_.at(static_cast<std::size_t>(row)); }

  BlockCoordinates block_of(const Vec3i& c) const { return {c[0] >> bits[0], c[1] >> bits[1], c[2] >> bits[2]}; }
  int32_t index_of(const Vec3i& c) const {
    return (c[0] & mask_[0]) | (c[1] & mask_[1]) << bits[0] | (c[2] & mask_[2]) << (bits[0] + bits[1]);
  }
  CellPlace place(const Vec3i& c) const { return {table_.find(block_of(c)), index_of(c)}; }
  Vec3i cell_at(CellPlace p) const;
  // NaN where nothing is.
  float clearance(const Vec3i& c) const;

  // The neighbour of a cell.
  CellPlace neighbour(CellPlace p, int number) const {
    const uint16_t there = neighbours_[static_cast<std::size_t>(p.index) * kAround + static_cast<std::size_t>(number)];
    return {block(p.row).around[there >> kIndexBits], there & ((1 << kIndexBits) - 1)};
  }
  // Whether all neighbours of a cell are in its block, `offset` of them apart.
  bool is_inner(CellPlace p) const { return inner_[static_cast<std::size_t>(p.index)] != 0; }
  int32_t offset(int number) const { return offset_[number]; }
  // Nodes of the current search.
  WayNode& node(CellPlace p, float unreached) {
    WayBlock& b = block(p.row);
    if (b.search != search_) begin_block(b, unreached);
    return b.nodes[static_cast<std::size_t>(p.index)];
  }
  // What the way from a cell to the goal costs at least, as far as that is known.
  float ahead(CellPlace p) const {
    const WayBlock& b = block(p.row);
    return b.goal == goal_ ? b.ahead[static_cast<std::size_t>(p.index)] : 0.0f;
  }

  // The place in cells of a point in metres.
  Vec3<double> to_cells(const double* metres) const;
  void to_metres(const Vec3<double>& cells, double* metres) const;

 private:
  int32_t make(BlockCoordinates at);
  void begin_block(WayBlock& block, float unreached);
  void learn(WayBlock& block);
  int mask_[3];
  int32_t offset_[kAround];
  std::vector<uint8_t> inner_;
  std::vector<uint16_t> neighbours_;  // of each cell of a block: number of the block around, index in it
  BlockTable table_;
  std::vector<WayBlock> blocks_;
  std::unordered_set<BlockCoordinates, PageHash, SamePage> finished_;
  uint32_t search_ = 0, goal_ = 0, first_ = 0;  // numbers of the search, of its goal, of the first search for that
  bool forgotten_ = false;
  std::size_t layout_ = 1;
  std::vector<float> costs_;  // of the ways that the searches from `first_` on found; negative: nothing is known
};

// Finds cells that lie near one another.
class CellReader {
 public:
  explicit CellReader(const WayGrid& grid) : grid_(grid) {}
  float clearance(const Vec3i& c);
  // Clearances at the 2^dimensions cells around a place whose lower one is `low`.
  void corners(const Vec3i& low, float* values);
  // At a place, NaN beside a cell that may not be entered; `gradient` may be null.
  float interpolate(const Vec3<double>& place, double* gradient = nullptr);
  const WayGrid& grid() const { return grid_; }

 private:
  const WayGrid& grid_;
  BlockCoordinates at_{0, 0, 0};
  const float* values_ = nullptr;
  bool valid_ = false;
};

}  // namespace ggslam::driving
