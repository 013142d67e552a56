// SPDX-License-Identifier: Apache-2.0
// The distance of voxels from single discs, and what a warp knows of the nearest discs of its voxels.
//
// Every voxel has the disc that is nearest by the rounded formula below; of discs at the same distance, the one whose
// voxel has the lower z, then y, then x. So the result depends on the sites alone, not on the order in which they are
// tried; as no product is fused with a sum, it is the compiled core's (native/src/volumes/kernels/esdf_search.hpp).
#pragma once
#include "volumes/field_nodes.cuh"
#include "native/formulas/disc_bounds.hpp"

namespace ggslam::cuda {

struct DiscGap {
  float from[3], height, aside;  // along the normal; beside it, from the middle
};

struct Disc {
  float at[3], normal[3], radius;
};

__device__ inline Disc disc_of(const FieldSites& s, int q) {
  return {{s.at[0][q], s.at[1][q], s.at[2][q]}, {s.normal[0][q], s.normal[1][q], s.normal[2][q]}, s.radius[q]};
}

__device__ inline float unfused_dot(const float (&a)[3], const float (&b)[3]) {
  return __fadd_rn(__fadd_rn(__fmul_rn(a[0], b[0]), __fmul_rn(a[1], b[1])), __fmul_rn(a[2], b[2]));
}

// `place` from the first voxel of the disc's block.
__device__ inline DiscGap gap_to(const float (&place)[3], const Disc& disc) {
  DiscGap gap;
  for (int a = 0; a < 3; ++a) gap.from[a] = place[a] - disc.at[a];
  gap.height = unfused_dot(gap.from, disc.normal);
  const float square = unfused_dot(gap.from, gap.from);
  gap.aside = sqrtf(maximum(__fadd_rn(square, -__fmul_rn(gap.height, gap.height)), 0.0f));
  return gap;
}

__device__ inline float square_of(const DiscGap& gap, const Disc& disc) {
  const float beyond = maximum(gap.aside - disc.radius, 0.0f);
  return __fadd_rn(__fmul_rn(gap.height, gap.height), __fmul_rn(beyond, beyond));
}

// A voxel of the block at work.
struct Seeker {
  float place[3];       // from the block's first voxel
  float square;         // to the nearest disc so far
  std::uint32_t owner;  // whose it is
  std::uint64_t order;  // of that disc among those at the same distance
};

// Where the disc of a number comes among others: by its voxel, from the block at work.
__device__ inline std::uint64_t order_of(int q, const std::int32_t (&shift)[3]) {
  const int voxel = voxel_of_number(q);
  const auto part = [](int x) { return static_cast<std::uint64_t>(x + 32768) & 0xffffu; };
  return part((voxel >> 6) + shift[2]) << 32 | part((voxel >> 3 & 7) + shift[1]) << 16 | part((voxel & 7) + shift[0]);
}

// Voxels from the block at work to that of a node.
__device__ inline void shift_of(const FieldNode& node, const std::int32_t* at, std::int32_t (&shift)[3]) {
  for (int a = 0; a < 3; ++a) shift[a] = kSide * (node.at[a] - at[a]);
}

// Voxels from the block at work to that of a slot.
__device__ inline void shift_of(const FieldJob& job, std::int32_t slot, const std::int32_t* at, std::int32_t (&shift)[3]) {
  const std::int32_t* there = job.map.blocks[job.field.sites[slot].row].at;
  for (int a = 0; a < 3; ++a) shift[a] = kSide * (there[a] - at[a]);
}

// Whether the disc becomes the voxel's.
__device__ inline bool offer(Seeker& s, const Disc& disc, std::int32_t slot, int q, const std::int32_t (&shift)[3]) {
  const float local[3] = {s.place[0] - static_cast<float>(shift[0]), s.place[1] - static_cast<float>(shift[1]),
                          s.place[2] - static_cast<float>(shift[2])};
  const float square = square_of(gap_to(local, disc), disc);
  if (square > s.square || (square == s.square && s.owner == kNobody)) return false;
  const std::uint64_t order = order_of(q, shift);
  if (square == s.square && order >= s.order) return false;
  s.square = square, s.order = order;
  s.owner = static_cast<std::uint32_t>(slot) * kVoxels + static_cast<std::uint32_t>(q);
  return true;
}

// Of the distance from a disc at a place.
__device__ inline void slope_of(const float (&place)[3], const Disc& disc, float (&slope)[3]) {
  const DiscGap gap = gap_to(place, disc);
  const float outside = gap.aside > disc.radius ? (gap.aside - disc.radius) / gap.aside : 0.0f;
  float square = 0;
  for (int a = 0; a < 3; ++a) {
    slope[a] = gap.height * disc.normal[a] + outside * (gap.from[a] - gap.height * disc.normal[a]);
    square += slope[a] * slope[a];
  }
  const float scale = square > 0 ? 1 / sqrtf(square) : 0.0f;
  for (int a = 0; a < 3; ++a) slope[a] *= scale;
}

// The gradient of the signed distance from a disc, packed.
__device__ inline std::uint32_t gradient_of(const float (&place)[3], const Disc& disc, float distance, float sign) {
  const DiscGap gap = gap_to(place, disc);
  // So close to the surface, the side that the value tells and that of the disc may differ.
  const float facing = distance < 0.5f || gap.height * sign >= 0 ? 1.0f : -1.0f;
  const float radius = disc.radius > 0 ? disc.radius + volumes::kSmoothRim : 0.0f;
  const float beyond = maximum(gap.aside - radius, 0.0f), outside = beyond / maximum(gap.aside, 1e-6f);
  const float scale = sign / maximum(sqrtf(gap.height * gap.height + beyond * beyond), 1e-6f);
  std::uint32_t packed = 0;
  for (int a = 0; a < 3; ++a) {
    const float along = gap.from[a] - gap.height * disc.normal[a];
    const float beside = scale * (gap.height * disc.normal[a] + outside * along);
    const float g = minimum(maximum(radius >= gap.aside ? facing * disc.normal[a] : beside, -1.0f), 1.0f);
    packed |= static_cast<std::uint32_t>(truncate(g * 511.0f + 511.5f)) << (10 * a);
  }
  return packed;
}

}  // namespace ggslam::cuda
