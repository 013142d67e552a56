// SPDX-License-Identifier: Apache-2.0
#include <cstring>

#include "volumes/surface_cells.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

// Eight bytes that are 0 or 1 as bits, the first byte the lowest.
uint64_t packed(const uint8_t* flags) {
  uint64_t eight;
  std::memcpy(&eight, flags, 8);
  return (eight * 0x0102040810204080ull) >> 56;
}

void pack(const uint8_t* flags, volumes::BlockBits& out) {
  for (int k = 0; k < volumes::kSide; ++k) {
    uint64_t word = 0;
    for (int j = 0; j < volumes::kSide; ++j) word |= packed(flags + 64 * k + 8 * j) << (8 * j);
    out.word[k] = word;
  }
}

}  // namespace

// Returns whether any voxel that is seen lies inside.
bool block_signs(const volumes::VoxelBlock& voxels, uint16_t min_weight, volumes::BlockSigns* out) {
  uint8_t inside[volumes::kVoxels], seen[volumes::kVoxels];
  for (int v = 0; v < volumes::kVoxels; ++v) inside[v] = voxels.value[v] < 0;
  for (int v = 0; v < volumes::kVoxels; ++v) seen[v] = voxels.weight[v] >= min_weight;
  pack(inside, out->inside);
  pack(seen, out->seen);
  uint64_t any = 0;
  for (int k = 0; k < volumes::kSide; ++k) any |= out->inside.word[k] & out->seen.word[k];
  return any != 0;
}

}  // namespace ggslam::GGSLAM_ISA
