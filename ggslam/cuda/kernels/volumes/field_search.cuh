// SPDX-License-Identifier: Apache-2.0
// The nearest discs of the voxels of a block, by a block of threads, a thread for each. A warp's voxels are a box of 4 x 4
// x 2; what may be near one of them is found by the warp together, a lane for each node or disc in question.
#pragma once
#include "volumes/field_discs.cuh"

namespace ggslam::cuda {

constexpr int kMostNear = 1024;  // slots near a block; if there are more, all are tried

// Half the diagonal of a block: from its middle to the centres of its corner voxels.
constexpr float kBlockReach = 6.0622f;
constexpr float kBlockMiddle = 0.5f * (kSide - 1);

// Slots whose sites may matter to a block, found by all its threads.
struct NearSlots {
  std::int32_t slot[kMostNear];
  std::int32_t count;
  std::uint64_t least[kVoxels / kWarp];
};

__device__ inline std::uint64_t least_of_block(NearSlots& near, std::uint64_t x) {
  x = least_of_warp(x);
  __syncthreads();
  if (threadIdx.x % kWarp == 0) near.least[threadIdx.x / kWarp] = x;
  __syncthreads();
  for (const std::uint64_t other : near.least) x = other < x ? other : x;
  return x;
}

// Slots to be looked through: those of a list, or all up to a number.
struct SlotList {
  const std::int32_t* slot;  // null: all
  std::int32_t count;
  const FieldNode* nodes;    // of all sites in them that matter
  __device__ std::int32_t at(std::int32_t i) const { return slot == nullptr ? i : slot[i]; }
};

// What separates the middle of the block at work from a node's sites at least, and from one of them.
__device__ inline float gap_to_node(const FieldNode& node, const std::int32_t* at, float& there) {
  std::int32_t shift[3];
  shift_of(node, at, shift);
  float from[3];
  there = 0;
  for (int a = 0; a < 3; ++a) {
    const float place = kBlockMiddle - static_cast<float>(shift[a]), within = place - node.within[a];
    from[a] = place - node.middle[a];
    there += within * within;
  }
  return sqrtf(least_square(from, node.normal, node.radius, node.half));
}

// Finds the slots that may matter, if no voxel of the block at `at` is farther from its site than `most`; the nearest is
// returned, -1 if there are none. If they are too many, near.count is -1.
__device__ inline std::int32_t find_near(const SlotList& list, const std::int32_t* at, float most, NearSlots& near) {
  std::uint64_t best = ~std::uint64_t{0}, first = ~std::uint64_t{0};
  for (std::int32_t i = threadIdx.x; i < list.count; i += kVoxels) {
    const std::int32_t slot = list.at(i);
    const FieldNode node = list.nodes[slot];
    if (node.count == 0) continue;
    float there;
    const float least = gap_to_node(node, at, there);
    const std::uint64_t a = ordered(there, 0), b = ordered(least, static_cast<std::uint32_t>(slot));
    best = a < best ? a : best, first = b < first ? b : first;
  }
  best = least_of_block(near, best);
  first = least_of_block(near, first);
  if (threadIdx.x == 0) near.count = 0;
  __syncthreads();
  if (first == ~std::uint64_t{0}) return -1;
  const float nearest = sqrtf(__uint_as_float(static_cast<std::uint32_t>(best >> 32)));
  const float limit = minimum(nearest + 2 * kBlockReach, most + kBlockReach) + 0.01f;
  for (std::int32_t i = threadIdx.x; i < list.count; i += kVoxels) {
    const std::int32_t slot = list.at(i);
    const FieldNode node = list.nodes[slot];
    if (node.count == 0) continue;
    float there;
    if (!(gap_to_node(node, at, there) <= limit)) continue;
    const std::int32_t n = atomicAdd(&near.count, 1);
    if (n < kMostNear) near.slot[n] = slot;
  }
  __syncthreads();
  return near.count == 0 ? -1 : static_cast<std::int32_t>(first & 0xffffffffu);
}

// A warp at work on its voxels.
struct Search {
  const FieldJob& job;
  const std::int32_t* at;        // the block's
  const FieldNode* nodes;        // of what is offered: [9, site_room]
  bool of_arrivals;
  float slack;
  Reach reach;                   // of the lanes that ask
  bool asks;                     // this lane
};

// Sets the reach to what the lanes that ask have.
__device__ inline void ask(Search& search, const Seeker& seeker) {
  const unsigned asking = __ballot_sync(kAllLanes, search.asks);
  const std::uint32_t owner = __shfl_sync(kAllLanes, seeker.owner, asking == 0 ? 0 : __ffs(static_cast<int>(asking)) - 1);
  float slope[3] = {0, 0, 0};
  if (owner != kNobody) {
    const std::int32_t slot = static_cast<std::int32_t>(owner / kVoxels);
    std::int32_t shift[3];
    shift_of(search.job, slot, search.at, shift);
    float middle[3];
    for (int a = 0; a < 3; ++a) middle[a] = search.reach.middle[a] - static_cast<float>(shift[a]);
    slope_of(middle, disc_of(search.job.field.sites[slot], static_cast<int>(owner % kVoxels)), slope);
  }
  float most = sqrtf(seeker.square) * 1.00001f;
  for (int a = 0; a < 3; ++a) {
    search.reach.slope[a] = slope[a];
    most -= slope[a] * (seeker.place[a] - search.reach.middle[a]);
  }
  search.reach.most = most_of_warp(search.asks ? most : -3e38f);
}

// Whether a disc of some thickness in the block that `shift` leads to may matter to the lanes that ask.
__device__ inline bool may_matter(const Search& search, const float* middle, const float* normal, float radius, float half,
                                  const std::int32_t (&shift)[3]) {
  float from[3];
  for (int a = 0; a < 3; ++a) from[a] = (search.reach.middle[a] - static_cast<float>(shift[a])) - middle[a];
  return may_be_nearer(search.reach, from, normal, radius, half);
}

// Offers the sites of half a part that may matter; whether a lane took one.
__device__ inline bool offer_half(Search& search, Seeker& seeker, const FieldSites& sites, std::int32_t slot, int first,
                                  const std::int32_t (&shift)[3]) {
  const int q = first + static_cast<int>(threadIdx.x % kWarp);
  bool near = bit_of(search.of_arrivals ? sites.came : sites.held, q);
  if (near) {
    const Disc disc = disc_of(sites, q);
    near = may_matter(search, disc.at, disc.normal, disc.radius + search.slack, search.slack, shift);
  }
  bool taken = false;
  for (unsigned left = __ballot_sync(kAllLanes, near); left != 0; left &= left - 1) {
    const int one = first + __ffs(static_cast<int>(left)) - 1;
    if (search.asks) taken |= offer(seeker, disc_of(sites, one), slot, one, shift);
  }
  return taken;
}

// Offers the sites of a slot, part by part.
__device__ inline void offer_slot(Search& search, Seeker& seeker, std::int32_t slot) {
  const FieldSites& sites = search.job.field.sites[slot];
  std::int32_t shift[3];
  shift_of(search.job, slot, search.at, shift);
  const int lane = threadIdx.x % kWarp;
  bool near = lane < kParts;
  if (near) {
    const FieldNode node = search.nodes[static_cast<std::int64_t>(1 + lane) * search.job.field.site_room + slot];
    near = node.count > 0 && may_matter(search, node.middle, node.normal, node.radius, node.half, shift);
  }
  bool taken = false;
  for (unsigned left = __ballot_sync(kAllLanes, near); left != 0; left &= left - 1) {
    const int first = (__ffs(static_cast<int>(left)) - 1) * kInPart;
    taken |= offer_half(search, seeker, sites, slot, first, shift);
    taken |= offer_half(search, seeker, sites, slot, first + kWarp, shift);
  }
  if (__ballot_sync(kAllLanes, taken) != 0) ask(search, seeker);
}

// Offers what was found near the block, the nearest first.
__device__ inline void offer_near(Search& search, Seeker& seeker, const SlotList& all, const NearSlots& near,
                                  std::int32_t first) {
  ask(search, seeker);
  offer_slot(search, seeker, first);
  const bool few = near.count <= kMostNear;
  const std::int32_t count = few ? near.count : all.count;
  const int lane = threadIdx.x % kWarp;
  for (std::int32_t begin = 0; begin < count; begin += kWarp) {
    const std::int32_t i = begin + lane;
    const std::int32_t slot = i < count ? (few ? near.slot[i] : all.at(i)) : -1;
    bool matters = slot >= 0 && slot != first;
    if (matters) {
      const FieldNode node = search.nodes[slot];
      std::int32_t shift[3];
      shift_of(node, search.at, shift);
      matters = node.count > 0 && may_matter(search, node.middle, node.normal, node.radius, node.half, shift);
    }
    for (unsigned left = __ballot_sync(kAllLanes, matters); left != 0; left &= left - 1)
      offer_slot(search, seeker, __shfl_sync(kAllLanes, slot, __ffs(static_cast<int>(left)) - 1));
  }
}

}  // namespace ggslam::cuda
