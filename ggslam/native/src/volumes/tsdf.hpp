// SPDX-License-Identifier: Apache-2.0
// A truncated signed distance field in blocks of 8^3 voxels, found by hashing (M. Niessner et al., "Real-time 3D
// Reconstruction at Scale using Voxel Hashing", 2013). Blocks that are free space throughout hold no voxels.
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "native/formulas/tsdf_rules.hpp"
#include "volumes/block_table.hpp"

namespace ggslam::volumes {

// Voxel (i, j, k) of a block stands at row i + 8 j + 64 k.
struct alignas(64) VoxelBlock {
  int16_t value[kVoxels];    // signed distance / truncation * 32767; positive in front of the surface
  uint16_t weight[kVoxels];  // / largest weight * 65535; 0: never seen
  uint16_t label[kVoxels];   // 0: none
  uint8_t red[kVoxels], green[kVoxels], blue[kVoxels];
  uint8_t votes[kVoxels];    // for `label`, less those against it
};

// The measured points of a block, of maps that count them.
struct alignas(64) PointBlock {
  uint8_t hits[kVoxels];     // evidence of measured points in the voxel, see tsdf_rules.hpp
  uint8_t octants[kVoxels];  // where in the voxel they lie: octant (x, y, z) is bit x + 2 y + 4 z
};

// (i, j, k) of a row.
static inline Vec3i voxel_of(int row) { return {{row % kSide, row / kSide % kSide, row / (kSide * kSide)}}; }

// The centre of voxel (i, j, k) of block (x, y, z) is at (8 x + i + 0.5, 8 y + j + 0.5, 8 z + k + 0.5) voxels.
struct Block {
  BlockCoordinates at;
  int32_t slot = -1;         // of its voxels; -1: free throughout, all voxels with `free_weight`
  uint16_t free_weight = 0;
  uint8_t frozen = 0;        // decay leaves it alone
  uint32_t revision = 0;     // of the map when the block last changed
  uint32_t seen = 0;         // number of the last view that had the block in sight
};

struct FusionScratch;

class Tsdf {
 public:
  Tsdf(float voxel, float truncation, float max_weight);

  const float voxel, truncation, max_weight;
  uint32_t revision = 0;  // counts the changes of the map
  uint32_t views = 0;     // that were fused
  std::shared_ptr<FusionScratch> scratch;  // memory of the fusion; null until it is needed

  std::size_t size() const { return blocks_.size(); }
  std::size_t dense() const { return slots_used_ - free_slots_.size(); }
  std::size_t bytes() const;
  Block& block(std::size_t row) { return blocks_[row]; }
  const Block& block(std::size_t row) const { return blocks_[row]; }
  // Voxels of a block; null if it is free throughout.
  VoxelBlock* voxels(const Block& block) const {
    return block.slot < 0 ? nullptr : &pool_[block.slot / kChunk][block.slot % kChunk];
  }

  // The same of its measured points; null, too, if the map does not count them.
  PointBlock* points(const Block& block) const {
    return block.slot < 0 || points_.empty() ? nullptr : &points_[block.slot / kChunk][block.slot % kChunk];
  }
  bool counts_points() const { return counts_points_; }
  // From then on the map does; of what it has so far none are known.
  void count_points();

  // Row of a block; -1 if there is none. Rows change when blocks are erased.
  int64_t find(BlockCoordinates at) const;
  // Row of a block, made (free throughout, never seen) if there is none.
  std::size_t insert(BlockCoordinates at);
  // Gives a block that is free throughout voxels of its own.
  VoxelBlock* densify(Block& block);
  // Makes a block free throughout; its voxels' memory is kept for others.
  void collapse(Block& block, uint16_t weight);
  // The last block takes the place of the erased one.
  void erase(std::size_t row);
  void clear();

 private:
  void add_chunk();
  static constexpr int kChunk = 256;
  std::vector<Block> blocks_;
  std::vector<std::unique_ptr<VoxelBlock[]>> pool_;
  std::vector<std::unique_ptr<PointBlock[]>> points_;  // as pool_, or none
  bool counts_points_ = false;
  std::vector<int32_t> free_slots_;
  std::size_t slots_used_ = 0;
  BlockTable table_;  // rows of blocks_
};

}  // namespace ggslam::volumes
