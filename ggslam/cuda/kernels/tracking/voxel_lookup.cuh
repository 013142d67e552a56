// SPDX-License-Identifier: Apache-2.0
// Voxels of a target on the device: their hash table and the search for the nearest one, which visits the same voxels in
// the same order as native/src/tracking/kernels/voxel_lookup.hpp.
#pragma once
#include "common/platform.cuh"
#include "abi/cuda/tracking.hpp"

namespace ggslam::cuda {

constexpr std::uint64_t kEmptyKey = ~std::uint64_t{0};
constexpr int kTableThreads = 128;

__device__ inline std::uint64_t block_key(int x, int y, int z) {
  constexpr std::uint64_t kMask = (std::uint64_t{1} << 21) - 1;
  return (static_cast<std::uint64_t>(x + (1 << 20)) & kMask) |
         (static_cast<std::uint64_t>(y + (1 << 20)) & kMask) << 21 |
         (static_cast<std::uint64_t>(z + (1 << 20)) & kMask) << 42;
}

__device__ inline std::uint64_t hash_key(std::uint64_t key) {
  key *= 0x9E3779B97F4A7C15ull;
  key ^= key >> 32;
  key *= 0xD6E8FEB86659FD93ull;
  return key ^ (key >> 32);
}

// Puts a block into a table, or what changed of it where its key is there; others do so with other blocks meanwhile. Which
// of two blocks that meet comes first depends on chance; what a look-up finds does not.
__device__ inline void put_block(const VoxelLevel& level, std::uint64_t key, std::uint64_t occupied,
                                 std::uint64_t first) {
  std::uint64_t place = hash_key(key) & level.slot_mask;
  for (;; place = (place + 1) & level.slot_mask) {
    unsigned long long* there = reinterpret_cast<unsigned long long*>(&level.slots[place].key);
    const std::uint64_t found =
        atomicCAS(there, static_cast<unsigned long long>(kEmptyKey), static_cast<unsigned long long>(key));
    if (found == kEmptyKey || found == key) break;
  }
  level.slots[place].occupied = occupied;
  level.slots[place].first = first;
}

// Blocks of the old table go to the new one, whose keys are all kEmptyKey.
__global__ void __launch_bounds__(kTableThreads) move_table_kernel(VoxelLevelJob job) {
  const std::uint64_t i = static_cast<std::uint64_t>(blockIdx.x) * kTableThreads + threadIdx.x;
  if (i > job.old_mask) return;
  const VoxelSlot slot = job.old_slots[i];
  if (slot.key != kEmptyKey) put_block(job.level, slot.key, slot.occupied, slot.first);
}

// Thread i has block i and voxel i, which is not of that block.
__global__ void __launch_bounds__(kTableThreads) change_level_kernel(VoxelLevelJob job) {
  const int i = static_cast<int>(blockIdx.x * kTableThreads + threadIdx.x);
  if (i < job.block_count) {
    const VoxelBlock block = job.blocks[i];
    put_block(job.level, block.key, block.occupied, block.first);
  }
  if (i >= job.voxel_count) return;
  if (job.new_moments != nullptr)
    job.moments[job.indices[i]] = job.new_moments[i];
  else
    job.voxels[job.indices[i]] = job.new_voxels[i];
}

// Bits of a 4 x 4 x 4 block whose x (y, z) lies in [low, high]; bit x + 4 y + 16 z.
__device__ inline std::uint64_t bits_x(int low, int high) {
  return ((2ull << high) - (1ull << low)) * 0x1111111111111111ull;
}
__device__ inline std::uint64_t bits_y(int low, int high) {
  return ((16ull << (4 * high)) - (1ull << (4 * low))) * 0x0001000100010001ull;
}
__device__ inline std::uint64_t bits_z(int low, int high) {
  const std::uint64_t above = high == 3 ? 0 : 1ull << (16 * (high + 1));
  return above - (1ull << (16 * low));
}

// The voxels of the block of a key among those of `mask`, and the index of the block's first one.
__device__ inline std::uint64_t find_voxels(const VoxelLevel& level, std::uint64_t key, std::uint64_t mask,
                                            VoxelSlot* found) {
  for (std::uint64_t place = hash_key(key) & level.slot_mask;; place = (place + 1) & level.slot_mask) {
    *found = level.slots[place];
    if (found->key == key) return found->occupied & mask;
    if (found->key == kEmptyKey) return 0;
  }
}

// Calls visit(index) for each occupied voxel among the 27 whose coordinates begin at `low`, in a fixed order.
template <class Visit>
__device__ inline void visit_neighbourhood(const VoxelLevel& level, const int (&low)[3], const Visit& visit) {
  for (int bz = low[2] >> 2; bz <= (low[2] + 2) >> 2; ++bz) {
    const std::uint64_t mask_z = bits_z(max(low[2] - 4 * bz, 0), min(low[2] + 2 - 4 * bz, 3));
    for (int by = low[1] >> 2; by <= (low[1] + 2) >> 2; ++by) {
      const std::uint64_t mask_yz = mask_z & bits_y(max(low[1] - 4 * by, 0), min(low[1] + 2 - 4 * by, 3));
      for (int bx = low[0] >> 2; bx <= (low[0] + 2) >> 2; ++bx) {
        VoxelSlot slot;
        const std::uint64_t mask = mask_yz & bits_x(max(low[0] - 4 * bx, 0), min(low[0] + 2 - 4 * bx, 3));
        for (std::uint64_t rest = find_voxels(level, block_key(bx, by, bz), mask, &slot); rest; rest &= rest - 1) {
          const std::uint64_t below = (rest & (~rest + 1)) - 1;
          visit(static_cast<int>(slot.first) + __popcll(slot.occupied & below));
        }
      }
    }
  }
}

// The least coordinates of the 27 voxels around a point.
__device__ inline void neighbourhood_of(const VoxelLevel& level, const float (&p)[3], int (&low)[3]) {
#pragma unroll
  for (int a = 0; a < 3; ++a) low[a] = static_cast<int>(floorf(p[a] * level.inverse_size)) - 1;
}

// Index of the voxel whose mean is nearest to p, not farther than a voxel's edge, and whose normal agrees; or -1.
__device__ inline int nearest_voxel(const VoxelLevel& level, const float (&p)[3], const float (&normal)[3],
                                    float min_dot) {
  int best = -1, low[3];
  float nearest = level.size * level.size;
  neighbourhood_of(level, p, low);
  visit_neighbourhood(level, low, [&](int index) {
    const Voxel& v = level.voxels[index];
    const float dx = v.mean[0] - p[0], dy = v.mean[1] - p[1], dz = v.mean[2] - p[2];
    const float distance = dx * dx + dy * dy + dz * dz;
    const float dot = v.normal[0] * normal[0] + v.normal[1] * normal[1] + v.normal[2] * normal[2];
    if (distance < nearest && dot > min_dot) nearest = distance, best = index;
  });
  return best;
}

}  // namespace ggslam::cuda
