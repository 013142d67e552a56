// SPDX-License-Identifier: Apache-2.0
// Visits the occupied voxels among the 27 around a point.
#pragma once
#include <algorithm>
#include <cmath>

#include "tracking/block_lookup.hpp"

namespace ggslam::GGSLAM_ISA {

// Far outside of any voxel where x is no number or too large.
static inline int voxel_coordinate(float x, float inverse_size) {
  return static_cast<int>(std::floor(std::min(std::max(-1e9f, x * inverse_size), 1e9f)));
}

// The voxel of coordinates (x, y, z), or -1.
static inline int find_voxel(const VoxelLevelView& level, int x, int y, int z) {
  const int block = find_block(level, block_key(x >> 2, y >> 2, z >> 2));
  if (block < 0) return -1;
  const uint64_t bit = 1ull << ((x & 3) + 4 * (y & 3) + 16 * (z & 3));
  const VoxelBlock& b = level.blocks[block];
  return b.occupied & bit ? static_cast<int>(b.first) + __builtin_popcountll(b.occupied & (bit - 1)) : -1;
}

// Calls visit(index) for each occupied voxel with coordinates within 1 of (x, y, z), in a fixed order.
template <typename Visit>
static inline void visit_neighbourhood(const VoxelLevelView& level, int x, int y, int z, Visit&& visit) {
  for (int bz = (z - 1) >> 2; bz <= (z + 1) >> 2; ++bz) {
    const uint64_t mask_z = bits_z(std::max(z - 1 - 4 * bz, 0), std::min(z + 1 - 4 * bz, 3));
    for (int by = (y - 1) >> 2; by <= (y + 1) >> 2; ++by) {
      const uint64_t mask_yz = mask_z & bits_y(std::max(y - 1 - 4 * by, 0), std::min(y + 1 - 4 * by, 3));
      for (int bx = (x - 1) >> 2; bx <= (x + 1) >> 2; ++bx) {
        const int block = find_block(level, block_key(bx, by, bz));
        if (block < 0) continue;
        const VoxelBlock& b = level.blocks[block];
        uint64_t found = b.occupied & mask_yz & bits_x(std::max(x - 1 - 4 * bx, 0), std::min(x + 1 - 4 * bx, 3));
        for (; found; found &= found - 1) {
          const uint64_t below = (found & (~found + 1)) - 1;
          visit(static_cast<int>(b.first) + __builtin_popcountll(b.occupied & below));
        }
      }
    }
  }
}

}  // namespace ggslam::GGSLAM_ISA
