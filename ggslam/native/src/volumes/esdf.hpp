// SPDX-License-Identifier: Apache-2.0
// Signed Euclidean distance field of a TSDF, brought up to date where the TSDF changed.
#pragma once
#include <memory>
#include <vector>

#include "common/buffer.hpp"
#include "common/context.hpp"
#include "abi/core/volumes.hpp"
#include "volumes/esdf_types.hpp"
#include "volumes/tsdf.hpp"

namespace ggslam::volumes {

struct FieldBlock {
  std::vector<Site> sites;
  std::unique_ptr<FieldVoxels> voxels;
  uint64_t known[kSide] = {}, negative[kSide] = {};  // voxel (i, j, k): bit i + 8 j of word k
  uint64_t crossed[kSide] = {};                      // voxels whose site is a zero crossing
  float required = 0;  // how far from its voxels sites were read last time at most, voxels; 0: never computed
};

// What the TSDF has in a block now: sites in the order of their voxels, and the bits of a FieldBlock.
struct BlockSites {
  std::vector<Site> sites;
  uint64_t known[kSide], negative[kSide];
};

// A block to compute and how far around it sites are looked for.
struct Task {
  int32_t row;
  float pad;
};

class Esdf {
 public:
  Esdf(const Tsdf& tsdf, float max_distance) : tsdf_(tsdf), max_distance_(max_distance / tsdf.voxel) {}

  FieldStats update(Context& context);
  void clear();
  std::size_t size() const { return blocks_.size(); }
  std::size_t bytes() const;
  const BlockTable& table() const { return table_; }
  const FieldBlock& block(std::size_t row) const { return blocks_[row]; }
  float voxel() const { return tsdf_.voxel; }

 private:
  // esdf_sites.cpp
  std::vector<int32_t> find_sites(Context& context, FieldStats& stats);  // rows of blocks whose known voxels changed
  void erase_gone(FieldStats& stats, std::vector<BlockCoordinates>& touched);
  void gather(BlockCoordinates at, int16_t* values) const;
  std::vector<int32_t> find_crossings(Context& context, const std::vector<int32_t>& rows,
                                      std::vector<BlockSites>& found);
  // esdf_thin.cpp
  void add_thin(int32_t row, BlockSites& found) const;
  // esdf_update.cpp
  std::vector<Task> affected(Context& context, const std::vector<int32_t>& changed) const;
  float first_pad(int32_t row) const;
  void compute(Context& context, std::vector<Task> tasks, FieldStats& stats);
  // esdf_box.cpp
  void solve(Context& context, const std::vector<Task>& tasks, const Box3i& box, FieldStats& stats,
             std::vector<Task>& again);
  void collect(Context& context, const Box3i& padded, const Box3i& frame);
  void transform(Context& context, const Box3i& box, const Box3i& frame);

  const Tsdf& tsdf_;
  const float max_distance_;  // voxels
  uint32_t revision_ = 0;     // of the TSDF at the last update
  BlockTable table_;
  std::vector<FieldBlock> blocks_;        // by row of the table
  std::vector<BlockCoordinates> site_changes_;  // blocks whose sites changed
  Box3i bounds_{};                        // of all blocks with sites

  // Of the box at work.
  std::vector<SiteCell> cells_;
  std::vector<BoxSite> sites_;
  std::vector<int32_t> neighbours_, row_start_;
  Buffer<int32_t> along_x_, nearest_;
};

// Splits tasks into boxes of blocks that together are cheap to compute, reordering them: `done` is called with a box
// (blocks) and its tasks.
struct TaskBox {
  Box3i box;
  std::size_t begin, end;
};
std::vector<TaskBox> split_into_boxes(std::vector<Task>& tasks, const BlockTable& table, const Box3i& bounds);
// The voxels of `box` (blocks) and `pad` around, but not farther than `bounds` (blocks).
Box3i padded_box(const Box3i& box, float pad, const Box3i& bounds);

}  // namespace ggslam::volumes
