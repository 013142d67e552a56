// SPDX-License-Identifier: Apache-2.0
// Several rays are walked at once, one per lane: which axis is next is as good as random, so a ray of its own would
// wait for a mispredicted branch at every other voxel.
#include "volumes/scan_rays.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

#if defined(__AVX512F__)
constexpr int kRays = 8;
#elif defined(__AVX2__)
constexpr int kRays = 4;
#else
constexpr int kRays = 2;
#endif

typedef double Double __attribute__((vector_size(8 * kRays), may_alias));
typedef std::int64_t Long __attribute__((vector_size(8 * kRays), may_alias));

inline Long as_long(Double v) { return (Long)v; }
inline Double as_double(Long v) { return (Double)v; }
inline Double load(const double* p) { return *reinterpret_cast<const Double*>(p); }
inline Long load(const std::int64_t* p) { return *reinterpret_cast<const Long*>(p); }

struct Axis {
  Double t, delta;
  Long step;
  Axis(const RayBatch& batch, int axis, int first)
      : t(load(batch.t[axis] + first)), delta(load(batch.delta[axis] + first)), step(load(batch.step[axis] + first)) {}
  void advance(Long chosen) { t += as_double(as_long(delta) & chosen); }
};

// Sets the bits of the lanes' voxels; each lane remembers the block it was in last.
struct Marker {
  VoxelMasks& masks;
  std::uint64_t codes[kRays];
  std::uint64_t* words[kRays];

  Marker(VoxelMasks& m, std::uint64_t start) : masks(m) {
    std::uint64_t* block = free_block(masks, start >> 9);
    for (int lane = 0; lane < kRays; ++lane) codes[lane] = start >> 9, words[lane] = block;
  }

  void mark(Long voxels) {
    alignas(64) std::uint64_t voxel[kRays];
    *reinterpret_cast<Long*>(voxel) = voxels;
    for (int lane = 0; lane < kRays; ++lane) {
      const std::uint64_t code = voxel[lane] >> 9;
      if (__builtin_expect(code != codes[lane], 0)) words[lane] = free_block(masks, codes[lane] = code);
      words[lane][(voxel[lane] >> 6) & 7] |= std::uint64_t{1} << (voxel[lane] & 63);
    }
  }
};

bool any(Long lanes) {
  std::int64_t bits = 0;
  for (int lane = 0; lane < kRays; ++lane) bits |= lanes[lane];
  return bits != 0;
}

}  // namespace

// Marks the voxels between the one of the rays' common origin and the last before their ends.
void walk_rays(const RayBatch& batch, std::uint64_t start, VoxelMasks& free) {
  const Long zero = {};
  const Long axis_x = zero + static_cast<std::int64_t>(kAxisX), axis_y = zero + static_cast<std::int64_t>(kAxisY),
             axis_z = zero + static_cast<std::int64_t>(kAxisZ);
  for (int first = 0; first < batch.count; first += kRays) {
    Axis x(batch, 0, first), y(batch, 1, first), z(batch, 2, first);
    const Double length = load(batch.length + first);
    const Long end = load(batch.end + first);
    Long lane_numbers{};
    for (int lane = 0; lane < kRays; ++lane) lane_numbers[lane] = first + lane;
    Long active = lane_numbers < zero + batch.count;
    Long voxel = zero + static_cast<std::int64_t>(start);
    Marker marker(free, start);
    while (any(active)) {
      const Long xy = x.t < y.t, xz = x.t < z.t, yz = y.t < z.t;
      const Long along_x = xy & xz, along_y = ~xy & yz, along_z = ~(along_x | along_y);
      x.advance(along_x), y.advance(along_y), z.advance(along_z);
      const Long axis = (along_x & axis_x) | (along_y & axis_y) | (along_z & axis_z);
      const Long step = (along_x & x.step) | (along_y & y.step) | (along_z & z.step);
      const Long next = (((voxel | ~axis) + step) & axis) | (voxel & ~axis);
      // Rounding may lead past the end's voxel: the ray then stops where its length is used up, as OctoMap's does.
      const Long within = (x.t <= length) | (y.t <= length) | (z.t <= length);
      active &= within & (next != end);
      voxel = (next & active) | (voxel & ~active);
      marker.mark(voxel);
    }
  }
}

}  // namespace ggslam::GGSLAM_ISA
