// SPDX-License-Identifier: Apache-2.0
// What a frame is aligned to: the map's Gaussians gathered in voxels at two levels.
#pragma once
#include <vector>

#include "context.hpp"
#include "tracking_types.hpp"

namespace ggslam {

struct VoxelLevel {
  std::vector<Voxel> voxels;
  std::vector<VoxelMoments> moments;
  std::vector<VoxelBlock> blocks;
  std::vector<uint64_t> block_keys;  // in the order of `blocks`
  std::vector<uint64_t> slot_key;
  std::vector<int32_t> slot_block;
  float size = 1;

  // Fills slot_key and slot_block from block_keys.
  void index_blocks();
  VoxelLevelView view() const;
};

struct GicpTarget {
  VoxelLevel fine, coarse;

  // Replaces the contents by what `base` (may be null) holds and the Gaussians of `input`. `base` must have been built
  // with the same settings. The result does not depend on the number of threads.
  void build(Context& context, const GicpTarget* base, const TargetInput& input, const TargetSettings& settings);
};

}  // namespace ggslam
