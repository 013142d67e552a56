// SPDX-License-Identifier: Apache-2.0
// Gaussians gathered in voxels on their own, ready to become part of a target: what a cell of a stored map is to it.
#pragma once
#include <vector>

#include "common/context.hpp"
#include "common/vector.hpp"
#include "tracking/tracking_types.hpp"

namespace ggslam {

Vec3i block_coordinates(uint64_t key);

// Moments of a voxel without members: bit `bit` of the block, voxels of `size` metres.
VoxelMoments empty_moments(uint64_t key, int bit, float size);

// Place of a fine block in the order of parts and composed targets: by coarse block, then by bit in it, so that fine
// block i is coarse voxel i and what lies together in space lies together in memory.
uint64_t block_order(uint64_t key);
uint64_t coarse_key_of(uint64_t order);

struct TargetPart {
  uint64_t rank = 0;               // decides the order in which parts are added up
  std::vector<uint64_t> orders;    // of the blocks, ascending
  std::vector<uint64_t> keys;
  std::vector<VoxelBlock> blocks;
  std::vector<VoxelMoments> moments, coarse_moments;  // of the voxels, and of each block as a coarse voxel
  std::vector<Voxel> voxels, coarse_voxels;  // as they are where no other part adds to them; empty if neighbours count

  // Uses one thread, the caller's.
  void build(Isa isa, const TargetInput& input, const TargetSettings& settings);
  std::size_t bytes() const;
};

// Moments of a fine block taken as a coarse voxel.
VoxelMoments coarse_moments(Isa isa, uint64_t key, const VoxelMoments* moments, std::size_t count, float coarse_size);

}  // namespace ggslam
