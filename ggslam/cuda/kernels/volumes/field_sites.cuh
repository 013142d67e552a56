// SPDX-License-Identifier: Apache-2.0
// Which surface points came, went or moved: native/src/volumes/esdf_sites.cpp and esdf_thin.cpp. A site keeps its place
// until its disc has moved by kHeld.
#pragma once
#include "volumes/field_nodes.cuh"

namespace ggslam::cuda {

struct FoundSite {
  float at[3], normal[3];  // at: from the centre of the block's first voxel
  float radius;
};

// Whether a voxel, or one at its faces, has a crossing.
__device__ inline bool crossed_near(const FieldJob& job, const HaloValues& values, int x, int y, int z) {
  const auto crossed = [&](int i, int j, int k) {
    const int face = i < 0 ? 1 : i >= kSide ? 2 : j < 0 ? 3 : j >= kSide ? 4 : k < 0 ? 5 : k >= kSide ? 6 : 0;
    const std::int32_t row = values.row[face];
    return row >= 0 && bit_of(job.field.rows[row].crossed, (i & 7) + kSide * (j & 7) + kSide * kSide * (k & 7));
  };
  return crossed(x, y, z) || crossed(x - 1, y, z) || crossed(x + 1, y, z) || crossed(x, y - 1, z) ||
         crossed(x, y + 1, z) || crossed(x, y, z - 1) || crossed(x, y, z + 1);
}

// The mean of the middles of octants, from the voxel's centre.
__device__ inline void middle_of_octants(std::uint32_t octants, float (&middle)[3]) {
  const float count = static_cast<float>(__popc(octants));
  for (int a = 0; a < 3; ++a) {
    const std::uint32_t upper = a == 0 ? 0xAAu : a == 1 ? 0xCCu : 0xF0u;
    const int more = __popc(octants & upper) - __popc(octants & ~upper);
    middle[a] = count > 0 ? 0.25f * static_cast<float>(more) / count : 0.0f;
  }
}

// The site of a voxel now; false if it has none. `hit`: whether points were measured in it.
__device__ inline bool site_now(const FieldJob& job, const HaloValues& values, int voxel, FoundSite& site, bool& hit) {
  const int place[3] = {voxel & 7, voxel >> 3 & 7, voxel >> 6};
  const FusedBlock& block = job.map.blocks[values.row[0]];
  hit = job.map.points != nullptr && block.slot >= 0 &&
        job.map.points[block.slot].hits[voxel] >= volumes::kOccupied;
  const std::int16_t* v = values.value + halo_place(place[0], place[1], place[2]);
  bool has = is_seen(*v) && point_of(v, site.at);
  if (has) {
    const float unit = job.map.truncation / job.map.voxel / static_cast<float>(volumes::kFreeValue);
    site.radius = normal_of(v, site.normal) ? radius_of(v, site.at, site.normal, unit) : 0.0f;
  } else if (hit && !crossed_near(job, values, place[0], place[1], place[2])) {
    middle_of_octants(job.map.points[block.slot].octants[voxel], site.at);
    site.normal[0] = site.normal[1] = site.normal[2] = site.radius = 0;
    has = true;
  }
  for (int a = 0; a < 3; ++a) site.at[a] += static_cast<float>(place[a]);
  return has;
}

// The slot of a row's sites, made if it has none; -1 if there is no room. One thread.
__device__ inline std::int32_t slot_for(const FieldJob& job, std::int32_t row) {
  FieldRow& r = job.field.rows[row];
  if (r.site_slot > 0) return r.site_slot - 1;
  std::int32_t* const counts = job.map.counts;
  const std::int32_t slot = counts[kSiteSlotsUsed] + atomicAdd(counts + kNewSlots, 1);
  if (slot >= job.field.site_room) {
    counts[kStoppedAt] = job.number;
    return -1;
  }
  FieldSites& sites = job.field.sites[slot];
  for (int k = 0; k < 8; ++k) sites.held[k] = sites.came[k] = sites.gone[k] = 0;
  sites.row = row, sites.touched = 0;
  r.site_slot = slot + 1;
  return slot;
}

// Whether a site is still the one that is held.
__device__ inline bool is_held(const FieldSites& sites, int q, const FoundSite& now) {
  const float at[3] = {sites.at[0][q], sites.at[1][q], sites.at[2][q]};
  const float normal[3] = {sites.normal[0][q], sites.normal[1][q], sites.normal[2][q]};
  return disc_shift(at, normal, sites.radius[q], now.at, now.normal, now.radius) <= volumes::kHeld;
}

// Writes down the sites of a block, by all its threads; returns whether any changed.
__device__ inline void take_sites(const FieldJob& job, FieldSites& sites, int q, bool has, bool lost, bool is_new,
                                  const FoundSite& now) {
  const unsigned held = __ballot_sync(kAllLanes, has), gone = __ballot_sync(kAllLanes, lost);
  const unsigned came = __ballot_sync(kAllLanes, is_new);
  const int warp = q / kWarp;
  if (q % kWarp == 0) {
    half_word(sites.held, warp) = held;
    half_word(sites.gone, warp) |= gone;
    half_word(sites.came, warp) = (half_word(sites.came, warp) | came) & held;
    atomicAdd(job.map.counts + kChangedSites, __popc(gone | came));
  }
  if (q == 0) sites.touched = 1;
  if (!is_new) return;
  for (int a = 0; a < 3; ++a) sites.at[a][q] = now.at[a], sites.normal[a][q] = now.normal[a];
  sites.radius[q] = now.radius;
}

// The known voxels, those with measured points among them.
__device__ inline void write_known(FieldRow& r, std::uint8_t* flags, int voxel, bool known) {
  flags[voxel] = known ? 1 : 0;
  __syncthreads();
  const unsigned word = __ballot_sync(kAllLanes, flags[threadIdx.x] != 0);
  if (threadIdx.x % kWarp == 0) half_word(r.known, threadIdx.x / kWarp) = word;
}

// A block of threads for each listed block of the map, a thread for each voxel, in the order of the sites.
__global__ void __launch_bounds__(kVoxels, 1) sites_kernel(FieldJob job, float slack) {
  GGSLAM_SHARED HaloValues values;
  GGSLAM_SHARED std::uint8_t flags[kVoxels];
  GGSLAM_SHARED std::int32_t shared_slot;
  if (job.map.counts[kStoppedAt] != 0 && job.map.counts[kStoppedAt] != job.number) return;
  const int q = threadIdx.x, voxel = voxel_of_number(q);
  const std::int32_t count = job.map.counts[kSiteRows];
  for (std::int32_t n = blockIdx.x; n < count; n += static_cast<std::int32_t>(gridDim.x)) {
    const std::int32_t row = job.field.listed[n];
    gather_values(job.map, row, values);
    FoundSite now{};
    bool hit;
    const bool has = site_now(job, values, voxel, now, hit);
    FieldRow& r = job.field.rows[row];
    write_known(r, flags, voxel, is_seen(values.value[halo_place(voxel & 7, voxel >> 3 & 7, voxel >> 6)]) || hit);
    const std::int32_t before = r.site_slot - 1;
    const bool was = before >= 0 && bit_of(job.field.sites[before].held, q);
    const bool keeps = was && has && is_held(job.field.sites[before], q, now);
    const bool lost = was && !keeps, is_new = has && !keeps;
    if (__syncthreads_count(lost || is_new) == 0) continue;
    if (q == 0) shared_slot = slot_for(job, row);
    __syncthreads();
    if (shared_slot < 0) continue;
    FieldSites& sites = job.field.sites[shared_slot];
    take_sites(job, sites, q, has, lost, is_new, now);
    __syncthreads();
    make_nodes(job.field, shared_slot, job.map.blocks[row].at, slack);
  }
}

// Slots of sites that were taken are used from here on, also if there were not enough. One thread.
__global__ void __launch_bounds__(kWarp) settle_sites_kernel(FieldJob job) {
  std::int32_t* const counts = job.map.counts;
  if (threadIdx.x != 0 || (counts[kStoppedAt] != 0 && counts[kStoppedAt] != job.number)) return;
  const std::int32_t wanted = counts[kSiteSlotsUsed] + counts[kNewSlots];
  counts[kSiteSlotsNeeded] = wanted;
  counts[kSiteSlotsUsed] = min(wanted, job.field.site_room);
}

// Lists the slots whose sites changed.
__global__ void __launch_bounds__(kListThreads) list_touched_kernel(FieldJob job) {
  if (is_stopped(job.map)) return;
  const std::int32_t slots = job.map.counts[kSiteSlotsUsed];
  for (std::int32_t s = static_cast<std::int32_t>(blockIdx.x) * kListThreads + static_cast<std::int32_t>(threadIdx.x);
       s < slots; s += static_cast<std::int32_t>(gridDim.x) * kListThreads)
    if (job.field.sites[s].touched != 0) job.field.arrived[atomicAdd(job.map.counts + kArrivedSlots, 1)] = s;
}

}  // namespace ggslam::cuda
