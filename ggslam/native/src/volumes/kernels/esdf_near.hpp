// SPDX-License-Identifier: Apache-2.0
// Functions of the formulas in native/formulas/disc_bounds.hpp, and which nodes may hold the nearest disc of a place.
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

// A number that is not negative, with the sign of another.
static inline Float signed_as(Float a, Float b) { return (Float)((Int)a | ((Int)b & broadcast_int(INT32_MIN))); }

}  // namespace ggslam::GGSLAM_ISA

#include "native/formulas/disc_bounds.hpp"

namespace ggslam::GGSLAM_ISA {

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
