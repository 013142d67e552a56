// SPDX-License-Identifier: Apache-2.0
// Which blocks of a distance field an update concerns, and their new distances.
#pragma once
#include "volumes/field_search.cuh"

namespace ggslam::cuda {

constexpr int kSelectThreads = 128;

__device__ inline bool is_gone(const FieldArrays& field, std::uint32_t owner) {
  if (owner == kNobody) return false;
  const FieldSites& sites = field.sites[owner / kVoxels];
  return sites.touched != 0 && bit_of(sites.gone, static_cast<int>(owner % kVoxels));
}

// Whether something may be different in a block, as far as one of its threads looks.
__device__ inline bool differs(const FieldJob& job, std::int32_t row) {
  const FieldRow& r = job.field.rows[row];
  const int t = threadIdx.x;
  if (job.anew != 0 || r.computed == 0) return true;
  if (t < kSide && (r.known[t] != r.done_known[t] || r.negative[t] != r.done_negative[t])) return true;
  for (int v = t; v < kVoxels; v += kSelectThreads)
    if (is_gone(job.field, job.field.distances[row].owner[v])) return true;
  for (std::int32_t i = t; i < job.map.counts[kArrivedSlots]; i += kSelectThreads) {
    const FieldNode node = job.field.arrivals[job.field.arrived[i]];
    float there;
    if (node.count > 0 && gap_to_node(node, job.map.blocks[row].at, there) <= r.farthest + kBlockReach + 0.01f)
      return true;
  }
  return false;
}

// Lists the blocks that an update concerns, a block of threads for each.
__global__ void __launch_bounds__(kSelectThreads) select_kernel(FieldJob job) {
  if (is_stopped(job.map)) return;
  const std::int32_t rows = job.map.counts[kRowsUsed];
  for (std::int32_t row = blockIdx.x; row < rows; row += static_cast<std::int32_t>(gridDim.x)) {
    if (job.map.blocks[row].present == 0) continue;
    if (__syncthreads_count(differs(job, row)) > 0 && threadIdx.x == 0)
      job.field.listed[atomicAdd(job.map.counts + kConcernedRows, 1)] = row;
  }
}

// What has to be done with a voxel.
struct VoxelTask {
  bool known, was_known, search, redo;  // search: its nearest site may be any; redo: measured again from the one it has
};

__device__ inline VoxelTask task_of(const FieldJob& job, const FieldRow& r, const FieldDistances& d, int voxel) {
  VoxelTask task;
  task.known = bit_of(r.known, voxel);
  task.was_known = job.anew == 0 && r.computed != 0 && bit_of(r.done_known, voxel);
  const bool kept = task.known && task.was_known;
  task.search = task.known && (!task.was_known || is_gone(job.field, d.owner[voxel]));
  task.redo = kept && !task.search && bit_of(r.negative, voxel) != bit_of(r.done_negative, voxel);
  return task;
}

// Gives a voxel what it had, as far as that is there.
__device__ inline Seeker seeker_of(const FieldJob& job, const std::int32_t* at, int voxel, std::uint32_t before) {
  Seeker s{{static_cast<float>(voxel & 7), static_cast<float>(voxel >> 3 & 7), static_cast<float>(voxel >> 6)},
           __fmul_rn(job.max_distance, job.max_distance), kNobody, 0};
  if (before == kNobody) return s;
  const std::int32_t slot = static_cast<std::int32_t>(before / kVoxels);
  const int q = static_cast<int>(before % kVoxels);
  if (!bit_of(job.field.sites[slot].held, q)) return s;
  std::int32_t shift[3];
  shift_of(job, slot, at, shift);
  offer(s, disc_of(job.field.sites[slot], q), slot, q, shift);
  return s;
}

__device__ inline void forget(FieldDistances& d, int voxel) {
  d.distance[voxel] = __uint_as_float(0x7fc00000u);
  d.gradient[voxel] = kNoGradient, d.owner[voxel] = kNobody;
}

// Writes down what a voxel has; returns its distance in voxels.
__device__ inline float write_voxel(const FieldJob& job, const std::int32_t* at, FieldDistances& d, int voxel,
                                    const Seeker& s, bool behind, bool writes) {
  const bool alone = s.owner == kNobody;
  const float sign = behind ? -1.0f : 1.0f, distance = alone ? job.max_distance : sqrtf(maximum(s.square, 0.0f));
  if (!writes) return distance;
  std::uint32_t gradient = kNoGradient;
  if (!alone) {
    const std::int32_t slot = static_cast<std::int32_t>(s.owner / kVoxels);
    std::int32_t shift[3];
    shift_of(job, slot, at, shift);
    float local[3];
    for (int a = 0; a < 3; ++a) local[a] = s.place[a] - static_cast<float>(shift[a]);
    gradient = gradient_of(local, disc_of(job.field.sites[slot], static_cast<int>(s.owner % kVoxels)), distance, sign);
  }
  d.distance[voxel] = sign * distance * job.map.voxel;
  d.gradient[voxel] = gradient, d.owner[voxel] = s.owner;
  return distance;
}

// Offers the voxels of a block what came and, where they search, all there is.
__device__ inline void seek(const FieldJob& job, const FieldRow& r, const std::int32_t* at, const VoxelTask& task,
                            float slack, NearSlots& near, Seeker& s) {
  const int box = threadIdx.x / kWarp, part = box / 2;
  const float middle[3] = {1.5f + 4.0f * (part & 1), 1.5f + 4.0f * (part >> 1 & 1),
                           0.5f + 4.0f * (part >> 2) + 2.0f * (box & 1)};
  Search search{job, at, job.field.arrivals, true, slack, {{middle[0], middle[1], middle[2]}, {1.5f, 1.5f, 0.5f}, {}, 0},
                task.known && !task.search};
  const std::int32_t arrived = job.map.counts[kArrivedSlots];
  if (job.anew == 0 && r.computed != 0 && arrived > 0) {
    const SlotList list{job.field.arrived, arrived, job.field.arrivals};
    const std::int32_t first = find_near(list, at, r.farthest, near);
    if (first >= 0 && __ballot_sync(kAllLanes, search.asks) != 0) offer_near(search, s, list, near, first);
    __syncthreads();
  }
  if (__syncthreads_count(task.search) == 0) return;
  const SlotList all{nullptr, job.map.counts[kSiteSlotsUsed], job.field.nodes};
  const std::int32_t first = find_near(all, at, job.max_distance, near);
  search.nodes = job.field.nodes, search.of_arrivals = false, search.asks = task.search;
  if (first >= 0 && __ballot_sync(kAllLanes, search.asks) != 0) offer_near(search, s, all, near, first);
  __syncthreads();
}

// New distances of the listed blocks, a block of threads for each, a thread for each voxel, in the order of sites.
__global__ void __launch_bounds__(kVoxels, 1) distances_kernel(FieldJob job, float slack) {
  GGSLAM_SHARED NearSlots near;
  if (is_stopped(job.map)) return;
  const int voxel = voxel_of_number(threadIdx.x);
  const std::int32_t count = job.map.counts[kConcernedRows];
  for (std::int32_t n = blockIdx.x; n < count; n += static_cast<std::int32_t>(gridDim.x)) {
    const std::int32_t row = job.field.listed[n];
    FieldRow& r = job.field.rows[row];
    FieldDistances& d = job.field.distances[row];
    const std::int32_t* at = job.map.blocks[row].at;
    const VoxelTask task = task_of(job, r, d, voxel);
    const std::uint32_t before = task.known && task.was_known ? d.owner[voxel] : kNobody;
    Seeker s = seeker_of(job, at, voxel, before);
    seek(job, r, at, task, slack, near, s);
    const bool writes = task.search || task.redo || (task.known && s.owner != before);
    float distance = 0;
    if (task.known) distance = write_voxel(job, at, d, voxel, s, bit_of(r.negative, voxel), writes);
    else if (task.was_known || job.anew != 0 || r.computed == 0) forget(d, voxel);
    const std::uint64_t least = least_of_block(near, ordered(job.max_distance + 1 - distance, 0));
    const int computed = __syncthreads_count(writes);
    if (threadIdx.x < kSide) {
      r.done_known[threadIdx.x] = r.known[threadIdx.x], r.done_negative[threadIdx.x] = r.negative[threadIdx.x];
    }
    if (threadIdx.x == 0) {
      r.farthest = job.max_distance + 1 - __uint_as_float(static_cast<std::uint32_t>(least >> 32)) + 1e-3f;
      r.computed = 1;
      atomicAdd(job.map.counts + kComputedVoxels, computed);
    }
    __syncthreads();
  }
}

// What changed is done with: a thread for each row and each slot.
__global__ void __launch_bounds__(kListThreads) finish_update_kernel(FieldJob job) {
  if (is_stopped(job.map)) return;
  std::int32_t* const counts = job.map.counts;
  const std::int32_t first = static_cast<std::int32_t>(blockIdx.x) * kListThreads + static_cast<std::int32_t>(threadIdx.x);
  const std::int32_t stride = static_cast<std::int32_t>(gridDim.x) * kListThreads;
  for (std::int32_t row = first; row < counts[kRowsUsed]; row += stride) job.field.rows[row].marks = 0;
  for (std::int32_t s = first; s < counts[kSiteSlotsUsed]; s += stride) {
    FieldSites& sites = job.field.sites[s];
    if (sites.touched == 0) continue;
    sites.touched = 0;
    for (int k = 0; k < 8; ++k) sites.came[k] = sites.gone[k] = 0;
  }
  if (first == 0) counts[kFieldRevision] = job.number;
}

}  // namespace ggslam::cuda
