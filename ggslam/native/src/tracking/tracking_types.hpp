// SPDX-License-Identifier: Apache-2.0
// Plain structures shared by the tracking kernels (compiled per instruction set) and those that start them.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/core/tracking.hpp"

namespace ggslam {

// --- voxel grid the points are aligned to --------------------------------------------------------------------------

// Voxels are grouped in blocks of 4 x 4 x 4; those of a block lie one after the other in the order of their bits.
struct VoxelBlock {
  uint64_t occupied;  // bit x + 4 y + 16 z
  uint32_t first;     // index of the voxel of the lowest bit
  uint32_t version;   // of a growing target: the first one that has the block so
};

struct VoxelLevelView {
  const Voxel* voxels;
  const VoxelBlock* blocks;
  const int32_t* previous;    // of a growing target: the block that each one replaced, or -1
  const uint64_t* slot_key;   // open addressing, capacity slot_mask + 1; kEmptyKey marks a free slot
  const int32_t* slot_block;
  uint64_t slot_mask;
  float size, inverse_size;
  uint32_t version;           // what later ones brought is not seen
};

constexpr uint64_t kEmptyKey = ~uint64_t{0};

inline uint64_t block_key(int x, int y, int z) {
  constexpr uint64_t kMask = (uint64_t{1} << 21) - 1;
  return (static_cast<uint64_t>(x + (1 << 20)) & kMask) | (static_cast<uint64_t>(y + (1 << 20)) & kMask) << 21 |
         (static_cast<uint64_t>(z + (1 << 20)) & kMask) << 42;
}

inline uint64_t hash_key(uint64_t key) {
  key *= 0x9E3779B97F4A7C15ull;
  key ^= key >> 32;
  key *= 0xD6E8FEB86659FD93ull;
  return key ^ (key >> 32);
}

// --- alignment -----------------------------------------------------------------------------------------------------

// Sums over a block of points, in the order of AlignSums::h: upper triangle of the 6x6 matrix row by row.
struct AlignSums {
  double h[21];
  double b[6];
  double cost;
  double matches;
};

struct PlaneSums {
  double information[21];
  double inliers, squared;  // number, sum of squared point-to-plane distances
};

// One linearisation: points [begin, end) of `points` against `level` at the pose.
struct LinearizeArgs {
  AlignPoints points;
  VoxelLevelView level;
  AlignSettings settings;
  float kernel_factor;
  float rotation[9], translation[3];  // T_world_camera
  int32_t point_step;                 // every point_step-th point is used
  int32_t* match;                     // [n] voxel, or -1
  float* squared_distance;            // [n] squared point-to-plane distance, or +inf
  float* searched_at;                 // [n, 3] where `match` was searched from; NaN: not yet. Null: search always
};

// --- photometric part ------------------------------------------------------------------------------------------------

struct PhotometricArgs {
  PhotometricPoints points;
  PhotometricReferenceView reference;
  float rotation[9], translation[3];  // T_world_camera
  float gain, bias;                   // I_reference = gain I_frame + bias
  float huber, depth_tolerance;
};

struct PhotometricSums {
  double h[36];  // upper triangle of 8x8: twist, gain, bias
  double b[8];
  double cost, count, absolute;
};

}  // namespace ggslam
