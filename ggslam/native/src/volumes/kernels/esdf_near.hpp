// SPDX-License-Identifier: Apache-2.0
// Which discs may be the nearest of the voxels around a place. Two bounds: a disc is farther from a voxel than from the
// middle of some voxels less the way between them; and, as the distance of a convex body is convex, not nearer than it is
// from the middle with its slope there. The second tells far discs apart that the first cannot: nearly all that is far away
// is nearly as far.
#pragma once
#include <algorithm>
#include <cmath>

#include "common/kernels/simd.hpp"
#include "volumes/esdf_types.hpp"

namespace ggslam::GGSLAM_ISA {

// 1 / root(a) of a positive number, within a thousandth.
static inline Float inverse_root(Float a) {
#if defined(__AVX512F__)
  return (Float)_mm512_maskz_rsqrt14_ps(kAll, (__m512)a);
#elif defined(__AVX2__)
  return (Float)_mm256_rsqrt_ps((__m256)a);
#else
  return 1.0f / square_root(a);
#endif
}

// The root of a number that is not negative, less up to a thousandth of it.
static inline Float root_below(Float a) {
  const Float positive = maximum(a, broadcast(1e-12f));
  return positive * inverse_root(positive) * 0.9995f;
}

// a b + c, in bounds only, where it does not matter how it is rounded.
static inline Float product_sum(Float a, Float b, Float c) {
#if defined(__AVX512F__)
  return (Float)_mm512_maskz_fmadd_ps(kAll, (__m512)a, (__m512)b, (__m512)c);
#elif defined(__FMA__)
  return (Float)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
#else
  return a * b + c;
#endif
}

// What the square of the distance from a disc of some thickness is at least. `from` leads from its middle to the place.
static inline Float least_square(const Float from[3], const Float normal[3], Float radius, Float half) {
  const Float height = product_sum(from[0], normal[0], product_sum(from[1], normal[1], from[2] * normal[2]));
  const Float square = product_sum(from[0], from[0], product_sum(from[1], from[1], from[2] * from[2]));
  const Float above = maximum(absolute(height) - half, Float{});
  const Float aside = maximum(root_below(product_sum(-height, height, square)) - radius, Float{});
  return product_sum(above, above, aside * aside);
}

// What is known of the nearest discs of some voxels: none of them is farther from its own than
// `most` + slope (voxel - middle).
struct Reach {
  float middle[3], half[3];  // of the voxels
  float slope[3];
  float most;
};

// Which of kLanes discs of some thickness may be nearer to one of the voxels than what that has; `from` leads from their
// middles to that of the voxels.
static inline Mask may_be_nearer(const Reach& reach, const Float from[3], const Float normal[3], Float radius,
                                 Float half) {
  const Float height = product_sum(from[0], normal[0], product_sum(from[1], normal[1], from[2] * normal[2]));
  const Float square = product_sum(from[0], from[0], product_sum(from[1], from[1], from[2] * from[2]));
  const Float above = maximum(absolute(height) - half, Float{});
  const Float aside_square = maximum(product_sum(-height, height, square), broadcast(1e-12f));
  const Float aside_inverse = inverse_root(aside_square);
  const Float beyond = maximum(aside_square * aside_inverse * 0.9995f - radius, Float{});
  const Float distance_square = maximum(product_sum(above, above, beyond * beyond), broadcast(1e-12f));
  const Float inverse = inverse_root(distance_square), distance = distance_square * inverse * 0.9995f;
  const Float along = beyond * aside_inverse * inverse;
  const Float signed_above = (Float)((Int)above | ((Int)height & broadcast_int(INT32_MIN)));
  const Float across = signed_above * inverse - height * along;
  Float least = distance;
  for (int a = 0; a < 3; ++a) {
    const Float slope = product_sum(from[a], along, normal[a] * across);
    least = product_sum(absolute(slope - reach.slope[a]), broadcast(-reach.half[a]), least);
  }
  // The slopes are rounded, too.
  return greater_equal(broadcast(reach.most + 0.01f), least);
}

// Nodes that may hold the nearest site of a place within `reach` of `middle`, if none is farther from its nearest site
// than `most`: the nearest first, and the others; returns their number. `scratch` has room for all and a full vector.
static inline int nodes_near(const volumes::NodeColumns& nodes, const float middle[3], float reach, float most,
                             float* scratch, int32_t* out) {
  if (nodes.count == 0 || most < 0) return 0;
  const int32_t origin[3] = {nodes.origin.x, nodes.origin.y, nodes.origin.z};
  Float nearest = broadcast(3e38f);
  for (int i = 0; i < nodes.count; i += kLanes) {
    Float from[3], normal[3], within[3];
    for (int a = 0; a < 3; ++a) {
      Float place = broadcast(middle[a]);
      if (nodes.at[a] != nullptr) place += to_float((origin[a] - load_int(nodes.at[a] + i)) * volumes::kSide);
      from[a] = place - load(nodes.column(a) + i);
      normal[a] = load(nodes.column(3 + a) + i);
      within[a] = place - load(nodes.column(8 + a) + i);
    }
    const Float least = square_root(least_square(from, normal, load(nodes.column(6) + i), load(nodes.column(7) + i)));
    store(scratch + i, least);
    const Float there = within[0] * within[0] + within[1] * within[1] + within[2] * within[2];
    nearest = minimum(nearest, select(greater(broadcast(static_cast<float>(nodes.count - i)), lane_numbers()), there,
                                      broadcast(3e38f)));
  }
  float best = 3e38f;
  for (int lane = 0; lane < kLanes; ++lane) best = std::min(best, nearest[lane]);
  const float limit = std::min(std::sqrt(best) + 2 * reach, most + reach) + 0.01f;
  int n = 0;
  for (int i = 0; i < nodes.count; i += kLanes) {
    std::uint32_t left = bits(greater_equal(broadcast(limit), load(scratch + i)));
    if (nodes.count - i < kLanes) left &= (1u << (nodes.count - i)) - 1;
    for (; left != 0; left &= left - 1) out[n++] = i + __builtin_ctz(left);
  }
  int first = 0;
  for (int i = 1; i < n; ++i)
    if (scratch[out[i]] < scratch[out[first]]) first = i;
  if (n > 0) std::swap(out[0], out[first]);
  return n;
}

}  // namespace ggslam::GGSLAM_ISA
