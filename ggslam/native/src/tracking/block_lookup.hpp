// SPDX-License-Identifier: Apache-2.0
// Finds blocks of voxels, and voxels in a block. Included in kernels, too: functions are static, one for each instruction
// set.
#pragma once
#include "tracking/tracking_types.hpp"

namespace ggslam {

// Bits of a 4 x 4 x 4 block whose x (y, z) lies in [low, high]; bit x + 4 y + 16 z.
static inline uint64_t bits_x(int low, int high) { return ((2ull << high) - (1ull << low)) * 0x1111111111111111ull; }
static inline uint64_t bits_y(int low, int high) {
  return ((16ull << (4 * high)) - (1ull << (4 * low))) * 0x0001000100010001ull;
}
static inline uint64_t bits_z(int low, int high) {
  const uint64_t above = high == 3 ? 0 : 1ull << (16 * (high + 1));
  return above - (1ull << (16 * low));
}

// The block of a key, or -1. Slots may be filled meanwhile by a thread that makes a later version: a block is complete
// when a slot leads to it.
static inline int find_block(const VoxelLevelView& level, uint64_t key) {
  for (uint64_t slot = hash_key(key) & level.slot_mask;; slot = (slot + 1) & level.slot_mask) {
    const uint64_t found = __atomic_load_n(&level.slot_key[slot], __ATOMIC_ACQUIRE);
    if (found == kEmptyKey) return -1;
    if (found != key) continue;
    int block = __atomic_load_n(&level.slot_block[slot], __ATOMIC_ACQUIRE);
    while (block >= 0 && level.blocks[block].version > level.version) block = level.previous[block];
    return block;
  }
}

}  // namespace ggslam
