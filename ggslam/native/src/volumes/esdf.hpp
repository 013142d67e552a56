// SPDX-License-Identifier: Apache-2.0
// Signed Euclidean distance field of a TSDF, brought up to date where the TSDF changed.
#pragma once
#include <memory>
#include <vector>

#include "common/context.hpp"
#include "abi/core/volumes.hpp"
#include "volumes/esdf_types.hpp"
#include "volumes/tsdf.hpp"

namespace ggslam::volumes {

// Sites of a block, sorted into leaves.
struct SiteLeaves {
  std::vector<Site> sites;
  std::vector<Leaf> leaves;
  std::vector<float> columns;  // of the sites: kSiteColumns of them, each with room for a full vector behind
  std::size_t stride = 0;      // of the columns
};

struct FieldBlock {
  BlockCoordinates at;
  uint32_t slot;                                     // of its voxels among owners
  std::vector<Site> sites;                           // in the order of their voxels
  SiteLeaves tree, arrived;                          // of all; of those that came or moved since the last update
  std::unique_ptr<FieldVoxels> voxels;               // null: never computed
  uint64_t known[kSide] = {}, negative[kSide] = {};  // voxel (i, j, k): bit i + 8 j of word k
  uint64_t crossed[kSide] = {};                      // voxels whose site is a zero crossing
  uint64_t gone[kSide] = {};                         // voxels whose site went or moved since the last update
  uint64_t done_known[kSide] = {}, done_negative[kSide] = {};  // what `voxels` was computed for
  std::vector<uint32_t> owners;                      // slots of the blocks whose sites `voxels` has
  float farthest = 0;                                // no known voxel is farther from its site, voxels
  bool touched = false;                              // sites went or came since the last update
  bool anew = true;                                  // to be computed, whatever it has
  uint32_t waits = 0;                                // updates that had no time for it
  uint64_t orphans[kSide] = {};                      // voxels whose site went or moved, left over by those
  std::vector<uint32_t> missed;                      // owners of sites that came, left over
};

// Sites of a leaf at most: of all sites; of those that came, which lie more scattered.
constexpr std::ptrdiff_t kMostInLeaf = 32, kMostThatCame = 16;

// What the TSDF has in a block now: sites in the order of their voxels, and the bits of a FieldBlock.
struct BlockSites {
  std::vector<Site> sites;
  uint64_t known[kSide], negative[kSide];
};

// Nodes of groups, with room behind them for a full vector.
class NodeTable {
 public:
  void clear(std::size_t room);
  // A node from the first voxel of its block.
  void add(const Node& node, BlockCoordinates at, int32_t number);
  NodeColumns columns() const;  // places are those of the nodes' own blocks, if they were added so
  const int32_t* numbers() const { return numbers_.data(); }
  int32_t number(int i) const { return numbers_[i]; }
  int count() const { return static_cast<int>(numbers_.size()); }
  // Row `i` of another table, whose origin lies at `shift` from this one's.
  void add(const NodeTable& from, int i, const float shift[3]);
  BlockCoordinates at(int i) const { return {at_[i], at_[room_ + i], at_[2 * room_ + i]}; }

 private:
  std::vector<int32_t> at_;  // of the nodes' blocks; empty: places are counted from one
  std::size_t room_ = 0;
  std::vector<float> values_;
  std::vector<int32_t> numbers_;
};

// Looks for nodes that may hold the nearest site of voxels within `reach` of `middle`, none of which is farther from its
// site than `most`. Places are from the origin of the nodes.
class NearSearch {
 public:
  // How many there are.
  int find(Context& context, const NodeTable& nodes, const float middle[3], float reach, float most);
  // Puts them into `out`, whose origin they are moved to by `shift`.
  void list(Context& context, const NodeTable& nodes, const float middle[3], float reach, float most,
            const float shift[3], NodeTable& out);

 private:
  std::vector<float> least_;
  std::vector<int32_t> found_;
};

// Blocks that lie beside each other, and the groups that may matter to them.
struct Region {
  BlockCoordinates at;  // of its first block
  NodeTable all, arrived;  // from the first voxel of its first block
  float farthest = 0;
};

// What a thread keeps from one block to the next.
struct FieldWorker {
  NearSearch search;
  NodeTable all, arrived;
  std::vector<MissedSite> missed;
  int64_t blocks = 0, voxels = 0;  // that it computed
  int64_t put_off = 0;             // blocks
  double put_off_ms = 0;
};

// How long an update may take, and where it begins.
struct Deadline {
  double milliseconds;  // of the whole update; not positive: as long as it takes
  const double* place;  // [3] voxels; null: anywhere
};

class Esdf {
 public:
  Esdf(const Tsdf& tsdf, float max_distance);

  FieldStats update(Context& context, const Deadline& deadline);
  // Computes every block anew from the sites that the field holds.
  FieldStats recompute(Context& context);
  void clear();
  // Takes over a field of the TSDF as it is now. esdf_parts.cpp
  void take(const FieldParts& parts);
  std::size_t size() const { return blocks_.size(); }
  std::size_t bytes() const;
  const BlockTable& table() const { return table_; }
  const FieldBlock& block(std::size_t row) const { return *blocks_[row]; }
  float voxel() const { return tsdf_.voxel; }

 private:
  // esdf_sites.cpp
  void find_sites(Context& context, FieldStats& stats);
  FieldBlock& insert(BlockCoordinates at);
  void erase_gone(FieldStats& stats, std::vector<BlockCoordinates>& touched);
  void gather(BlockCoordinates at, int16_t* values) const;
  std::vector<int32_t> find_crossings(Context& context, const std::vector<int32_t>& rows,
                                      std::vector<BlockSites>& found);
  // esdf_thin.cpp
  void add_thin(int32_t row, BlockSites& found) const;
  // esdf_select.cpp
  void list_groups();
  void divide(Context& context);
  std::vector<int32_t> select(Context& context);
  bool concerns(Context& context, const FieldBlock& block, const Region& region, NearSearch& search) const;
  // esdf_update.cpp
  void sort(std::vector<int32_t>& rows, const Deadline& deadline) const;
  void bring_up(Context& context, int32_t row, bool late, FieldWorker& worker);
  void compute(Context& context, std::vector<int32_t>& rows, const Deadline& deadline, FieldStats& stats);
  void forget_changes();

  const Tsdf& tsdf_;
  const float max_distance_;  // voxels
  const float slack_;         // by which nodes are wider than what they hold, for roundings
  uint32_t revision_ = 0;     // of the TSDF at the last update
  BlockTable table_;
  std::vector<std::unique_ptr<FieldBlock>> blocks_;  // by row of the table
  std::vector<FieldBlock*> slots_;                   // null: free
  std::vector<uint32_t> free_slots_;
  std::vector<std::unique_ptr<FieldBlock>> erased_;  // in this update
  double put_off_ms_ = 0.005;                        // that it takes to put a block off
  int64_t left_ = 0;                                 // blocks that the last update had no time for

  // Of the update at work.
  std::vector<SiteGroup> groups_, arrivals_;
  NodeTable group_nodes_, arrival_nodes_;
  std::vector<SiteList> lists_;   // by slot
  std::vector<uint8_t> touched_;  // by slot
  std::vector<Region> regions_;
  std::vector<int32_t> region_of_;  // by row
};

// The middle of a block, from the first voxel of its region. esdf_select.cpp
Vec3f middle_in(const FieldBlock& block, const Region& region);
// Sorts sites into leaves of a few; `slack` widens their nodes. esdf_leaves.cpp
void make_leaves(const std::vector<Site>& sites, std::ptrdiff_t most, float slack, SiteLeaves& out);

}  // namespace ggslam::volumes
