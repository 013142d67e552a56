// SPDX-License-Identifier: Apache-2.0
// Fuses a view into the voxels of blocks, a block of threads for each, a thread for each voxel.
#pragma once
#include "volumes/point_marks.cuh"
#include "native/formulas/tsdf_voxel.hpp"

namespace ggslam::cuda {

// What all voxels have in common, see tsdf_voxel.hpp.
struct VoxelView {
  const float *depth, *eroded;
  double rotation[9], translation[3];
  std::int32_t width, height;
  float fx, fy, cx, cy;
  float step[3][3];  // from voxel to voxel along the map's axes, camera frame
  float truncation, voxel, edge, clearing, max_depth, weight_scale, max_free_weight;
};

// What happened to a block's voxels, bits of a warp; summed up in ten bits for each.
struct BlockFlags {
  bool changed, in_band, seen, unseen, occupied, hit;
};

// One voxel, as it is and as it becomes.
struct VoxelState {
  std::int32_t value, weight, label, red, green, blue, votes, hits, octants;
};

__device__ inline VoxelState voxel_before(const FuseJob& job, const FusedUpdate& update, int t) {
  if (update.was_free != 0) {
    const std::int32_t weight = update.was_present != 0 ? job.map.blocks[update.row].free_weight : 0;
    return {volumes::kFreeValue, weight, 0, 0, 0, 0, 0, weight > 0 ? volumes::kLeastHits : volumes::kNeverSeen, 0};
  }
  const FusedVoxels& v = job.map.voxels[update.slot];
  VoxelState s{v.value[t], v.weight[t], v.label[t], v.red[t], v.green[t], v.blue[t], v.votes[t], 0, 0};
  if (job.map.points != nullptr) {
    s.hits = job.map.points[update.slot].hits[t], s.octants = job.map.points[update.slot].octants[t];
  }
  return s;
}

__device__ inline void write_voxel(const FuseJob& job, const FusedUpdate& update, int t, const VoxelState& s) {
  FusedVoxels& v = job.map.voxels[update.slot];
  v.value[t] = static_cast<std::int16_t>(s.value), v.weight[t] = static_cast<std::uint16_t>(s.weight);
  v.label[t] = static_cast<std::uint16_t>(s.label), v.votes[t] = static_cast<std::uint8_t>(s.votes);
  v.red[t] = static_cast<std::uint8_t>(s.red), v.green[t] = static_cast<std::uint8_t>(s.green);
  v.blue[t] = static_cast<std::uint8_t>(s.blue);
  if (job.map.points == nullptr) return;
  job.map.points[update.slot].hits[t] = static_cast<std::uint8_t>(s.hits);
  job.map.points[update.slot].octants[t] = static_cast<std::uint8_t>(s.octants);
}

// Takes the mean of what rays told a voxel. Where the nearest pixel looks past it, or ends before it, it is left to that:
// rays of a thin thing's pixels would widen it by half a voxel.
__device__ inline void gather_rays(const FuseJob& job, const VoxelView& view, std::int32_t n, int t, Sighted& g) {
  FusedRays& place = job.rays[static_cast<std::int64_t>(n) * kVoxels + t];
  const FusedRays sum = place;
  if (sum.count != 0) place = {0, 0};
  if (!(g.distance < view.truncation && g.distance >= -view.truncation)) return;
  const bool alone = job.settings.integrator == 1;
  const float unit = view.truncation / volumes::kRayUnits;
  if (sum.count >= (alone ? 1 : job.settings.least_rays))
    g.distance = unit * static_cast<float>(sum.distance) / static_cast<float>(sum.count);
  else if (alone)
    g.distance = kNothing;
}

// Counts hits and misses of a voxel; whether what is occupied changed.
__device__ inline bool count_points(std::int32_t now, bool missed, VoxelState& s) {
  const std::int32_t before = s.hits, start = before == volumes::kNeverSeen ? volumes::kOccupied : before;
  if (now != 0) s.hits = min(start + volumes::kHit, volumes::kMostHits);
  else if (missed) s.hits = max(start - volumes::kMiss, volumes::kLeastHits);
  const bool is = s.hits >= volumes::kOccupied, was = before >= volumes::kOccupied;
  const std::int32_t kept = now != 0 || is ? now | s.octants : 0;
  const bool changed = is != was || (is && (kept & ~s.octants) != 0);
  s.octants = kept;
  return changed;
}

// Colour and label of a voxel near the surface; whether its label changed.
__device__ inline bool paint(const FuseJob& job, const VoxelView& view, const Sighted& g, VoxelState& s) {
  if (job.color != nullptr) {
    const std::uint8_t* c = job.color + 3 * static_cast<std::int64_t>(g.pixel);
    const float share = color_share((s.red | s.green | s.blue) == 0, g.share);
    s.red = blended(s.red, c[0], share), s.green = blended(s.green, c[1], share), s.blue = blended(s.blue, c[2], share);
  }
  if (job.labels == nullptr || !(g.share > 0) || fabsf(g.distance) > volumes::kLabelVoxels * view.voxel) return false;
  const std::uint16_t seen = job.labels[g.pixel];
  if (seen == 0) return false;
  std::uint16_t label = static_cast<std::uint16_t>(s.label);
  std::uint8_t votes = static_cast<std::uint8_t>(s.votes);
  const bool changed = vote_for(seen, label, votes);
  s.label = label, s.votes = votes;
  return changed;
}

// One voxel of an update: projected, compared, averaged.
__device__ inline BlockFlags fuse_voxel(const FuseJob& job, const VoxelView& view, std::int32_t n, int t,
                                        const float (&origin)[3], VoxelState& s) {
  float p[3];
  const float i = static_cast<float>(t & 7), j = static_cast<float>(t >> 3 & 7), k = static_cast<float>(t >> 6);
  for (int a = 0; a < 3; ++a)
    p[a] = i * view.step[0][a] + (origin[a] + j * view.step[1][a] + k * view.step[2][a]);
  bool seen, near;
  Sighted g = compared(view, p, seen, near);
  if (near) interpolate(view, g);
  if (job.rays != nullptr) gather_rays(job, view, n, t, g);
  BlockFlags flags{};
  if (seen) {
    const Averaged now = averaged(view, g, s.value, s.weight);
    s.value = now.value, s.weight = now.weight;
    flags.changed = now.changed, flags.in_band = now.band;
    if (now.band) flags.changed |= paint(job, view, g, s);
  }
  if (job.map.points != nullptr) {
    const std::uint32_t* words = job.octants + static_cast<std::int64_t>(n) * (kVoxels / 4);
    const auto now = static_cast<std::int32_t>(words[t / 4] >> (8 * (t & 3)) & 255u);
    flags.changed |= count_points(now, g.distance >= view.voxel, s);
    flags.in_band |= now != 0;
  }
  flags.seen = s.weight > 0, flags.unseen = s.weight == 0, flags.occupied = s.value != volumes::kFreeValue;
  flags.hit = s.hits >= volumes::kOccupied;
  return flags;
}

// Which of the flags any voxel of a block of threads has, and the least of the voxels' weights; for thread 0.
__device__ inline BlockFlags flags_of_all(const BlockFlags& f, std::int32_t weight, std::int32_t& least) {
  GGSLAM_SHARED unsigned first[kVoxels / kWarp], second[kVoxels / kWarp];
  GGSLAM_SHARED int most_missing[kVoxels / kWarp];
  const unsigned one = __reduce_add_sync(kAllLanes, f.changed | f.in_band << 10 | f.seen << 20);
  const unsigned two = __reduce_add_sync(kAllLanes, f.unseen | f.occupied << 10 | f.hit << 20);
  const int missing = __reduce_max_sync(kAllLanes, volumes::kFullWeight - weight);
  const int warp = threadIdx.x / kWarp;
  if (threadIdx.x % kWarp == 0) first[warp] = one, second[warp] = two, most_missing[warp] = missing;
  __syncthreads();
  if (threadIdx.x != 0) return {};
  unsigned all_one = 0, all_two = 0;
  int all_missing = 0;
  for (int w = 0; w < kVoxels / kWarp; ++w) {
    all_one += first[w], all_two += second[w];
    all_missing = max(all_missing, most_missing[w]);
  }
  least = volumes::kFullWeight - all_missing;
  constexpr unsigned kTen = 1023;
  return {(all_one & kTen) != 0, (all_one >> 10 & kTen) != 0, all_one >> 20 != 0,
          (all_two & kTen) != 0, (all_two >> 10 & kTen) != 0, all_two >> 20 != 0};
}

// Blocks that are free throughout give their voxels back; those that got voxels for nothing are as they were before.
__device__ inline void finish_block(const FuseJob& job, const FusedUpdate& update, const BlockFlags& f,
                                    std::int32_t least) {
  std::int32_t* const counts = job.map.counts;
  FusedBlock block = job.map.blocks[update.row];
  const bool was_present = update.was_present != 0, was_free = update.was_free != 0;
  const bool all_free = !f.unseen && !f.occupied && !f.hit, none_seen = !f.seen && !f.hit;
  const bool in_vain = was_present ? was_free && !f.in_band : none_seen;
  block.update = -1;
  if (all_free) {
    if (!was_free || !was_present) block.revision = static_cast<std::uint32_t>(job.revision);
    block.slot = -1, block.free_weight = least, block.present = 1;
  } else if (in_vain) {
    block.slot = -1;
    if (!was_present) block.free_weight = 0;
  } else {
    if (f.changed) block.revision = static_cast<std::uint32_t>(job.revision);
    block.slot = update.slot, block.present = 1;
  }
  job.map.blocks[update.row] = block;
  if (block.slot < 0) job.map.free_slots[atomicAdd(counts + kFreeSlots, 1)] = update.slot;
  if (all_free && !was_free) atomicAdd(counts + kFreedBlocks, 1);
  if (block.present != 0 && !was_present) atomicAdd(counts + kMadeBlocks, 1), atomicAdd(counts + kPresentBlocks, 1);
  const int more_dense = (block.slot >= 0 ? 1 : 0) - (was_free ? 0 : 1);
  if (more_dense != 0) atomicAdd(counts + kDenseBlocks, more_dense);
}

__global__ void __launch_bounds__(kVoxels) fuse_kernel(FuseJob job, VoxelView view) {
  if (is_stopped(job.map)) return;
  const int t = threadIdx.x;
  const std::int32_t count = job.map.counts[kUpdateCount];
  for (std::int32_t n = blockIdx.x; n < count; n += static_cast<std::int32_t>(gridDim.x)) {
    const FusedUpdate update = job.updates[n];
    const std::int32_t* at = job.map.blocks[update.row].at;
    float origin[3];
    const double voxel = static_cast<double>(view.voxel);
    const double x = voxel * (kSide * static_cast<double>(at[0]) + 0.5),
                 y = voxel * (kSide * static_cast<double>(at[1]) + 0.5),
                 z = voxel * (kSide * static_cast<double>(at[2]) + 0.5);
    for (int a = 0; a < 3; ++a) {
      const double* r = view.rotation + 3 * a;
      origin[a] = static_cast<float>(r[0] * x + r[1] * y + r[2] * z + view.translation[a]);
    }
    VoxelState state = voxel_before(job, update, t);
    const BlockFlags flags = fuse_voxel(job, view, n, t, origin, state);
    write_voxel(job, update, t, state);
    std::int32_t least = 0;
    const BlockFlags all = flags_of_all(flags, state.weight, least);  // after its barrier nobody reads the octants
    if (job.map.points != nullptr && t < kVoxels / 4) {
      std::uint32_t* const word = job.octants + static_cast<std::int64_t>(n) * (kVoxels / 4) + t;
      if (*word != 0) *word = 0;
    }
    if (t == 0) finish_block(job, update, all, least);
    __syncthreads();
  }
}

}  // namespace ggslam::cuda
