// SPDX-License-Identifier: Apache-2.0
// Which blocks of a map changed since a distance field was last brought up to date, and where their voxels' signs change:
// the rules of native/src/volumes/esdf_sites.cpp and kernels/esdf_crossings.cpp.
#pragma once
#include "volumes/fused_map.cuh"
#include "native/formulas/surface_sites.hpp"

namespace ggslam::cuda {

constexpr int kFaces = 6;
constexpr std::int32_t kFindCrossings = 1, kFindSites = 2;  // marks of rows
constexpr std::uint32_t kNobody = 0xffffffffu;
constexpr std::uint32_t kNoGradient = 511u | 511u << 10 | 511u << 20;

// The block at a face: -x, +x, -y, ...
__device__ inline std::int32_t block_at_face(const FusedMap& map, const std::int32_t* at, int face) {
  const int axis = face / 2, step = 2 * (face & 1) - 1;
  return find_block(map, at[0] + (axis == 0 ? step : 0), at[1] + (axis == 1 ? step : 0), at[2] + (axis == 2 ? step : 0));
}

// Marks blocks that changed, and those at their faces, whose sites depend on them; a thread for each row. The first block
// begins the operation: it sets its counts to 0.
__global__ void __launch_bounds__(kListThreads) mark_rows_kernel(FieldJob job) {
  const FusedMap& map = job.map;
  if (is_stopped(map)) return;
  const std::int32_t rows = map.counts[kRowsUsed];
  const std::uint32_t since = static_cast<std::uint32_t>(map.counts[kFieldRevision]);
  for (std::int32_t row = static_cast<std::int32_t>(blockIdx.x) * kListThreads + static_cast<std::int32_t>(threadIdx.x);
       row < rows; row += static_cast<std::int32_t>(gridDim.x) * kListThreads) {
    const FusedBlock& block = map.blocks[row];
    if (block.present == 0 || block.revision <= since) continue;
    atomicAdd(map.counts + kChangedRows, 1);
    atomicOr(&job.field.rows[row].marks, kFindCrossings);
    for (int face = 0; face < kFaces; ++face) {
      const std::int32_t other = block_at_face(map, block.at, face);
      if (other >= 0) atomicOr(&job.field.rows[other].marks, kFindCrossings);
    }
  }
}

// Sets the counts of an update to 0.
__global__ void __launch_bounds__(kWarp * 2) begin_update_kernel(FieldJob job) {
  if (!is_stopped(job.map) && threadIdx.x >= kCandidateCount && threadIdx.x < kFusedCounts)
    job.map.counts[threadIdx.x] = 0;
}

// Lists the rows that have one of some marks.
__global__ void __launch_bounds__(kListThreads) list_rows_kernel(FieldJob job, std::int32_t marks, int count) {
  if (is_stopped(job.map)) return;
  const std::int32_t rows = job.map.counts[kRowsUsed];
  for (std::int32_t row = static_cast<std::int32_t>(blockIdx.x) * kListThreads + static_cast<std::int32_t>(threadIdx.x);
       row < rows; row += static_cast<std::int32_t>(gridDim.x) * kListThreads)
    if ((job.field.rows[row].marks & marks) != 0) job.field.listed[atomicAdd(job.map.counts + count, 1)] = row;
}

// A block's values and those at its faces, as surface_sites.hpp reads them, and the rows they are of: the block's own and
// those at its faces, -1 where there is none.
struct HaloValues {
  std::int16_t value[volumes::kHalo * volumes::kHalo * volumes::kHalo];
  std::int32_t row[1 + kFaces];
};

__device__ inline std::int16_t value_of(const FusedMap& map, std::int32_t row, int voxel) {
  if (row < 0) return volumes::kUnseen;
  const FusedBlock& block = map.blocks[row];
  if (block.slot < 0) return block.free_weight == 0 ? volumes::kUnseen : volumes::kFreeValue;
  const FusedVoxels& v = map.voxels[block.slot];
  const std::int16_t value = v.value[voxel];
  return v.weight[voxel] == 0 ? volumes::kUnseen : value < -volumes::kFreeValue ? -volumes::kFreeValue : value;
}

__device__ inline int halo_place(int x, int y, int z) {
  return (x + 1) + volumes::kHalo * (y + 1) + volumes::kHalo * volumes::kHalo * (z + 1);
}

// All threads of a block of kVoxels call it.
__device__ inline void gather_values(const FusedMap& map, std::int32_t row, HaloValues& values) {
  const int t = threadIdx.x;
  __syncthreads();
  if (t == 0) values.row[0] = row;
  if (t > 0 && t <= kFaces) values.row[t] = block_at_face(map, map.blocks[row].at, t - 1);
  for (int i = t; i < volumes::kHalo * volumes::kHalo * volumes::kHalo; i += kVoxels) values.value[i] = volumes::kUnseen;
  __syncthreads();
  values.value[halo_place(t & 7, t >> 3 & 7, t >> 6)] = value_of(map, row, t);
  if (t < kFaces * kSide * kSide) {
    const int face = t / (kSide * kSide), axis = face / 2, u = t & 7, v = t >> 3 & 7;
    const int out = face & 1 ? kSide : -1, in = out & 7;
    const int place = axis == 0   ? halo_place(out, u, v)
                      : axis == 1 ? halo_place(u, out, v)
                                  : halo_place(u, v, out);
    const int voxel = axis == 0   ? in + kSide * u + kSide * kSide * v
                      : axis == 1 ? u + kSide * in + kSide * kSide * v
                                  : u + kSide * v + kSide * kSide * in;
    values.value[place] = value_of(map, values.row[1 + face], voxel);
  }
  __syncthreads();
}

// Half a word of a mask of voxels, which the threads of a warp stand for.
__device__ inline std::uint32_t& half_word(std::uint64_t* words, int warp) {
  return reinterpret_cast<std::uint32_t*>(words)[warp];
}

__device__ inline bool bit_of(const std::uint64_t* words, int number) { return (words[number >> 6] >> (number & 63) & 1) != 0; }

// Where signs change in the listed blocks. Where others do than before, what is thin in the blocks at the faces may be
// another.
__global__ void __launch_bounds__(kVoxels) crossings_kernel(FieldJob job) {
  GGSLAM_SHARED HaloValues values;
  if (is_stopped(job.map)) return;
  const int t = threadIdx.x, warp = t / kWarp;
  const std::int32_t count = job.map.counts[kListedRows];
  for (std::int32_t n = blockIdx.x; n < count; n += static_cast<std::int32_t>(gridDim.x)) {
    const std::int32_t row = job.field.listed[n];
    gather_values(job.map, row, values);
    const std::int16_t* v = values.value + halo_place(t & 7, t >> 3 & 7, t >> 6);
    float point[3];
    const bool known = is_seen(*v), crossed = known && point_of(v, point);
    const unsigned knowns = __ballot_sync(kAllLanes, known), crossings = __ballot_sync(kAllLanes, crossed);
    const unsigned negatives = __ballot_sync(kAllLanes, known && *v < 0);
    FieldRow& r = job.field.rows[row];
    bool differs = false;
    if (t % kWarp == 0) {
      differs = half_word(r.crossed, warp) != crossings;
      half_word(r.crossed, warp) = crossings;
      half_word(r.known, warp) = knowns, half_word(r.negative, warp) = negatives;
    }
    if (__syncthreads_count(differs) > 0 && t <= kFaces && values.row[t] >= 0)
      atomicOr(&job.field.rows[values.row[t]].marks, kFindSites);
  }
}

}  // namespace ggslam::cuda
