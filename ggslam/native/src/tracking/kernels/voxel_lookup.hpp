// SPDX-License-Identifier: Apache-2.0
// Visits the occupied voxels among the 27 around a point.
#pragma once
#include <algorithm>
#include <cmath>

#include "tracking/tracking_types.hpp"

namespace ggslam::GGSLAM_ISA {

// Bits of a 4 x 4 x 4 block whose x (y, z) lies in [low, high]; bit x + 4 y + 16 z.
static inline uint64_t bits_x(int low, int high) { return ((2ull << high) - (1ull << low)) * 0x1111111111111111ull; }
static inline uint64_t bits_y(int low, int high) {
  return ((16ull << (4 * high)) - (1ull << (4 * low))) * 0x0001000100010001ull;
}
static inline uint64_t bits_z(int low, int high) {
  const uint64_t above = high == 3 ? 0 : 1ull << (16 * (high + 1));
  return above - (1ull << (16 * low));
}

static inline int find_block(const VoxelLevelView& level, uint64_t key) {
  for (uint64_t slot = hash_key(key) & level.slot_mask;; slot = (slot + 1) & level.slot_mask) {
    if (level.slot_key[slot] == key) return level.slot_block[slot];
    if (level.slot_key[slot] == kEmptyKey) return -1;
  }
}

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
