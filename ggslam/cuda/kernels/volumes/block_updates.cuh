// SPDX-License-Identifier: Apache-2.0
// Gives the blocks that a view tells about rows and voxels, if there is room for all of them.
#pragma once
#include "volumes/candidates.cuh"

namespace ggslam::cuda {

// Whether what the view takes fits; else the map stops. One thread.
__global__ void __launch_bounds__(kWarp) admit_kernel(FuseJob job) {
  if (threadIdx.x != 0 || is_stopped(job.map)) return;
  std::int32_t* const counts = job.map.counts;
  std::int32_t listed = counts[kCandidateCount];
  for (int level = kLevelCounts; level < kFusedCounts; ++level) listed = max(listed, counts[level]);
  const std::int32_t rows = counts[kRowsUsed] + counts[kNewRows];
  const std::int32_t slots = counts[kSlotsUsed] + max(counts[kNewSlots] - counts[kFreeSlots], 0);
  const bool fits = listed <= job.list_room && rows <= job.map.row_room && slots <= job.map.slot_room &&
                    counts[kUpdateCount] <= job.update_room;
  if (!fits) {
    counts[kStoppedAt] = job.number;
    counts[kRowsNeeded] = rows, counts[kSlotsNeeded] = slots;
    counts[kListNeeded] = listed, counts[kUpdatesNeeded] = counts[kUpdateCount];
  }
  counts[kNewRows] = counts[kNewSlots] = counts[kUpdateCount] = 0;  // counted again as they are taken
}

__device__ inline std::int32_t take_row(const FusedMap& map, std::uint64_t key) {
  const std::int32_t row = map.counts[kRowsUsed] + atomicAdd(map.counts + kNewRows, 1);
  map.blocks[row] = {{coordinate_of(key, 0), coordinate_of(key, 1), coordinate_of(key, 2)}, -1, 0, 0, 0, -1};
  insert_row(map, key, row);
  return row;
}

__device__ inline std::int32_t take_slot(const FusedMap& map) {
  const std::int32_t n = atomicAdd(map.counts + kNewSlots, 1), free = map.counts[kFreeSlots];
  return n < free ? map.free_slots[free - 1 - n] : map.counts[kSlotsUsed] + n - free;
}

// Weight of a block that is free throughout after another view, in 65535ths of the largest.
__device__ inline std::int32_t grown_weight(std::int32_t weight, float measured, float most) {
  const float before = static_cast<float>(weight);
  const float total = minimum(before + floorf(measured + 0.5f), maximum(most, before));
  return static_cast<std::int32_t>(minimum(total, static_cast<float>(volumes::kFullWeight)));
}

// Notes free blocks and lists those whose voxels are to be updated, a thread for each candidate.
__global__ void __launch_bounds__(kListThreads) make_blocks_kernel(FuseJob job) {
  const FusedMap& map = job.map;
  if (is_stopped(map)) return;
  const float scale = static_cast<float>(volumes::kFullWeight) / map.max_weight;
  const float most = job.settings.max_free_weight * scale;
  const std::int32_t count = map.counts[kCandidateCount];
  for (std::int32_t i = static_cast<std::int32_t>(blockIdx.x) * kListThreads + static_cast<std::int32_t>(threadIdx.x);
       i < count; i += static_cast<std::int32_t>(gridDim.x) * kListThreads) {
    const FusedCandidate c = job.candidates[i];
    const std::int32_t row = c.row < 0 ? take_row(map, c.key) : c.row;
    FusedBlock& block = map.blocks[row];
    const bool dense = block.present != 0 && block.slot >= 0;
    if (c.sight == kFreeInSight && !dense) {
      if (block.present == 0) {
        block.present = 1, block.free_weight = 0;
        block.revision = static_cast<std::uint32_t>(job.revision);
        atomicAdd(map.counts + kMadeBlocks, 1);
      }
      block.free_weight = grown_weight(block.free_weight, scale / (c.z * c.z), most);
      continue;
    }
    const std::int32_t n = atomicAdd(map.counts + kUpdateCount, 1);
    job.updates[n] = {row, dense ? block.slot : take_slot(map), block.present, dense ? 0 : 1};
    block.update = n;
  }
}

// What was taken is used from here on. One thread.
__global__ void __launch_bounds__(kWarp) settle_kernel(FusedMap map) {
  if (threadIdx.x != 0 || is_stopped(map)) return;
  std::int32_t* const counts = map.counts;
  const std::int32_t again = min(counts[kNewSlots], counts[kFreeSlots]);
  counts[kRowsUsed] += counts[kNewRows];
  counts[kFreeSlots] -= again;
  counts[kSlotsUsed] += counts[kNewSlots] - again;
  counts[kPresentBlocks] += counts[kMadeBlocks];
}

// The number of the update of a block; -1: it has none.
__device__ inline std::int32_t update_of(const FuseJob& job, std::int32_t x, std::int32_t y, std::int32_t z) {
  const std::int32_t row = find_row(job.map, key_of(x, y, z));
  if (row < 0) return -1;
  const std::int32_t n = job.map.blocks[row].update;
  return n >= 0 && n < job.map.counts[kUpdateCount] && job.updates[n].row == row ? n : -1;
}

}  // namespace ggslam::cuda
