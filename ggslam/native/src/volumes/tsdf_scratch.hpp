// SPDX-License-Identifier: Apache-2.0
// Memory that the fusion keeps from view to view.
#pragma once
#include <algorithm>
#include <vector>

#include "volumes/tsdf_fusion.hpp"

namespace ggslam::volumes {

// What rays told a voxel within the truncation: the sum of its distances to the depth along the optical axis, in kUnits
// to the truncation, and their number.
struct RaySum {
  static constexpr int kUnits = kRayUnits;
  int32_t distance = 0, count = 0;
};

struct FusionScratch {
  struct Cell {
    int thread = 0;
    std::size_t begin = 0, end = 0;  // candidates of the cell among those of the thread
  };
  struct Update {
    BlockCoordinates at;
    VoxelBlock* voxels;
    int32_t row;
    bool is_new, was_free;
    unsigned flags;
  };
  FusionImages images;
  std::vector<std::vector<Candidate>> parts;
  std::vector<Cell> cells;
  std::vector<Candidate> candidates;
  std::vector<Update> updates;
  std::vector<BlockCoordinates> gone;
  std::vector<uint8_t> emptied;
  std::vector<int32_t> update_of_row;  // number of a block's update; -1: none
  std::vector<uint8_t> octants;        // [updates, kVoxels], those that the view has points in; else zero
  std::vector<uint8_t> marked;         // [updates], whether there are any
  std::vector<RaySum> rays;            // [updates, kVoxels]; zero but while a view is fused
  std::vector<uint8_t> passed;         // [updates], whether rays passed the block
};

}  // namespace ggslam::volumes
