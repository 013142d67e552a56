// SPDX-License-Identifier: Apache-2.0
// Discs of some thickness that hold the sites of a block, or of one of its parts of 4^3 voxels.
#pragma once
#include "volumes/field_rows.cuh"

namespace ggslam::cuda {

constexpr int kParts = 8, kInPart = 64;

// Voxel i + 8 j + 64 k of a site's number, see FieldSites.
__device__ inline int voxel_of_number(int q) {
  const int part = q >> 6;
  const int x = (q & 3) + 4 * (part & 1), y = (q >> 2 & 3) + 4 * (part >> 1 & 1), z = (q >> 4 & 3) + 4 * (part >> 2);
  return x + kSide * y + kSide * kSide * z;
}

__device__ inline float sum_of_warp(float x) {
  for (int bits = kWarp / 2; bits > 0; bits /= 2) x += __shfl_xor_sync(kAllLanes, x, bits);
  return x;
}

__device__ inline float most_of_warp(float x) {
  for (int bits = kWarp / 2; bits > 0; bits /= 2) x = fmaxf(x, __shfl_xor_sync(kAllLanes, x, bits));
  return x;
}

__device__ inline std::uint64_t least_of_warp(std::uint64_t x) {
  for (int bits = kWarp / 2; bits > 0; bits /= 2) {
    const std::uint64_t other = __shfl_xor_sync(kAllLanes, x, bits);
    x = other < x ? other : x;
  }
  return x;
}

// A number that is not negative and one to tell it from others of the same: in the order of the numbers.
__device__ inline std::uint64_t ordered(float x, std::uint32_t number) {
  return static_cast<std::uint64_t>(__float_as_uint(x)) << 32 | number;
}

// The middle of some sites and their mean normal, by a warp; returns how many there are.
__device__ inline int mean_disc(const FieldSites& s, const std::uint64_t* which, int first, int end, FieldNode& node) {
  float sums[7] = {0, 0, 0, 0, 0, 0, 0};
  for (int q = first + static_cast<int>(threadIdx.x % kWarp); q < end; q += kWarp) {
    if (!bit_of(which, q)) continue;
    for (int a = 0; a < 3; ++a) sums[a] += s.at[a][q], sums[3 + a] += s.normal[a][q];
    sums[6] += 1;
  }
  for (float& sum : sums) sum = sum_of_warp(sum);
  if (sums[6] == 0) return 0;
  const float length = sqrtf(sums[3] * sums[3] + sums[4] * sums[4] + sums[5] * sums[5]);
  for (int a = 0; a < 3; ++a) {
    node.middle[a] = sums[a] / sums[6];
    node.normal[a] = length > 1e-3f ? sums[3 + a] / length : (a == 2 ? 1.0f : 0.0f);
  }
  return static_cast<int>(sums[6]);
}

// A node of the sites first ... end - 1 that `which` has bits of, by a warp.
__device__ inline void make_node(const FieldSites& s, const std::int32_t* at, const std::uint64_t* which, int first,
                                 int end, float slack, FieldNode& out) {
  FieldNode node{};
  for (int a = 0; a < 3; ++a) node.at[a] = at[a];
  node.count = mean_disc(s, which, first, end, node);
  const int lane = threadIdx.x % kWarp;
  if (node.count == 0) {
    if (lane == 0) out = node;
    return;
  }
  float low = -3e38f, high = -3e38f, radius = 0;  // low: of the heights' negatives
  std::uint64_t nearest = ~std::uint64_t{0};
  for (int q = first + lane; q < end; q += kWarp) {
    if (!bit_of(which, q)) continue;
    float height = 0, cosine = 0, square = 0;
    for (int a = 0; a < 3; ++a) {
      const float from = s.at[a][q] - node.middle[a];
      height += from * node.normal[a], cosine += s.normal[a][q] * node.normal[a], square += from * from;
    }
    const float rim = s.radius[q] * sqrtf(fmaxf(0.0f, 1 - cosine * cosine));
    const float aside = sqrtf(fmaxf(0.0f, square - height * height));
    low = fmaxf(low, rim - height), high = fmaxf(high, height + rim), radius = fmaxf(radius, aside + s.radius[q]);
    const std::uint64_t place = ordered(square, static_cast<std::uint32_t>(q));
    nearest = place < nearest ? place : nearest;
  }
  low = most_of_warp(low), high = most_of_warp(high), radius = most_of_warp(radius), nearest = least_of_warp(nearest);
  if (lane != 0) return;
  const int q = static_cast<int>(nearest & 0xffffffffu);
  for (int a = 0; a < 3; ++a) {
    node.middle[a] += 0.5f * (high - low) * node.normal[a];
    node.within[a] = s.at[a][q];
  }
  node.radius = radius + slack, node.half = 0.5f * (high + low) + slack;
  out = node;
}

// The nodes of all sites of a slot and of those that came, by a block of threads.
__device__ inline void make_nodes(const FieldArrays& field, std::int32_t slot, const std::int32_t* at, float slack) {
  const FieldSites& s = field.sites[slot];
  for (int task = threadIdx.x / kWarp; task < 2 * (1 + kParts); task += kVoxels / kWarp) {
    const int part = task % (1 + kParts);
    const int first = part == 0 ? 0 : (part - 1) * kInPart, end = part == 0 ? kVoxels : first + kInPart;
    FieldNode* const nodes = task > kParts ? field.arrivals : field.nodes;
    make_node(s, at, task > kParts ? s.came : s.held, first, end, slack,
              nodes[static_cast<std::int64_t>(part) * field.site_room + slot]);
  }
}

}  // namespace ggslam::cuda
