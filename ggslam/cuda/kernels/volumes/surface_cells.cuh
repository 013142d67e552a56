// SPDX-License-Identifier: Apache-2.0
// Cells between eight voxels that are all known, some of them inside and some outside: native/src/volumes/
// surface_cells.cpp. A cell belongs to the block of its lowest voxel.
#pragma once
#include "volumes/fused_map.cuh"

namespace ggslam::cuda {

constexpr int kCornerSide = kSide + 1, kCorners = kCornerSide * kCornerSide * kCornerSide;
constexpr std::uint8_t kHasInside = 1, kHasCells = 2;
constexpr std::int32_t kUnknownValue = -32768;

// The value of a voxel of a row; unknown if that is -1 or the voxel's weight too small.
__device__ inline std::int32_t known_value(const FusedMap& map, std::int32_t row, int voxel, std::int32_t least) {
  if (row < 0) return kUnknownValue;
  const FusedBlock& block = map.blocks[row];
  if (block.slot < 0) return block.free_weight >= least ? volumes::kFreeValue : kUnknownValue;
  const FusedVoxels& v = map.voxels[block.slot];
  return v.weight[voxel] >= least ? max(static_cast<std::int32_t>(v.value[voxel]), kUnknownValue + 1) : kUnknownValue;
}

// Which blocks have voxels inside.
__global__ void __launch_bounds__(kVoxels) find_inside_kernel(CastJob job) {
  if (is_stopped(job.map)) return;
  const std::int32_t rows = job.map.counts[kRowsUsed];
  for (std::int32_t row = blockIdx.x; row < rows; row += static_cast<std::int32_t>(gridDim.x)) {
    const FusedBlock& block = job.map.blocks[row];
    const bool dense = block.present != 0 && block.slot >= 0;
    const std::int32_t value = dense ? known_value(job.map, row, threadIdx.x, job.least_weight) : 0;
    const int count = __syncthreads_count(value < 0 && value != kUnknownValue);
    if (threadIdx.x == 0) job.kinds[row] = count > 0 ? kHasInside : 0;
  }
}

// A block's values and those that its cells reach into.
struct CornerValues {
  std::int32_t row[8];  // of the block at x + 2 y + 4 z
  std::int32_t inside;  // whether any of them has voxels inside
  std::int16_t value[kCorners];
};

// All threads of a block of kVoxels call it. False: there can be no surface.
__device__ inline bool gather_corners(const CastJob& job, std::int32_t row, CornerValues& c) {
  const int t = threadIdx.x;
  __syncthreads();
  if (t == 0) c.inside = 0;
  __syncthreads();
  if (t < 8) {
    const std::int32_t* at = job.map.blocks[row].at;
    c.row[t] = t == 0 ? row : find_block(job.map, at[0] + (t & 1), at[1] + (t >> 1 & 1), at[2] + (t >> 2));
    if (c.row[t] >= 0 && (job.kinds[c.row[t]] & kHasInside) != 0) c.inside = 1;
  }
  __syncthreads();
  if (c.inside == 0) return false;
  for (int i = t; i < kCorners; i += kVoxels) {
    const int x = i % kCornerSide, y = i / kCornerSide % kCornerSide, z = i / (kCornerSide * kCornerSide);
    const int which = (x >> 3) + 2 * (y >> 3) + 4 * (z >> 3);
    const int voxel = (x & 7) + kSide * (y & 7) + kSide * kSide * (z & 7);
    c.value[i] = static_cast<std::int16_t>(known_value(job.map, c.row[which], voxel, job.least_weight));
  }
  __syncthreads();
  return true;
}

__global__ void __launch_bounds__(kVoxels) find_cells_kernel(CastJob job) {
  GGSLAM_SHARED CornerValues corners;
  if (is_stopped(job.map)) return;
  const int t = threadIdx.x;
  const std::int32_t rows = job.map.counts[kRowsUsed];
  for (std::int32_t row = blockIdx.x; row < rows; row += static_cast<std::int32_t>(gridDim.x)) {
    if (job.map.blocks[row].present == 0 || !gather_corners(job, row, corners)) continue;
    const int first = (t & 7) + kCornerSide * (t >> 3 & 7) + kCornerSide * kCornerSide * (t >> 6);
    int inside = 0, known = 0;
    for (int k = 0; k < 8; ++k) {
      const std::int16_t v =
          corners.value[first + (k & 1) + kCornerSide * (k >> 1 & 1) + kCornerSide * kCornerSide * (k >> 2)];
      inside += v < 0, known += v != kUnknownValue;
    }
    const unsigned word = __ballot_sync(kAllLanes, known == 8 && inside > 0 && inside < 8);
    if (t % kWarp == 0) reinterpret_cast<std::uint32_t*>(job.cells + 8 * static_cast<std::int64_t>(row))[t / kWarp] = word;
    if (__syncthreads_count(word != 0) > 0 && t == 0) job.kinds[row] |= kHasCells;
  }
}

}  // namespace ggslam::cuda
