// SPDX-License-Identifier: Apache-2.0
// Surface points of a block of the TSDF: zero crossings on the edges between voxels.
#include <algorithm>
#include <cmath>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

#include "volumes/esdf_types.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

using namespace ggslam::volumes;

constexpr int kSteps[3] = {1, kHalo, kHalo * kHalo};

constexpr float kHalfRoot = 0.70710678f;
constexpr float kRim[8][2] = {{1, 0}, {-1, 0}, {0, 1}, {0, -1}, {kHalfRoot, kHalfRoot}, {-kHalfRoot, kHalfRoot},
                              {kHalfRoot, -kHalfRoot}, {-kHalfRoot, -kHalfRoot}};
// How far a rim may stand out of the surface, voxels: less is noise.
constexpr float kMayStandOut = 0.1f;
constexpr float kRadiusSteps = 8;

bool seen(int16_t value) { return value != kUnseen; }

// Gradient of the values, central where both neighbours were seen; false if it is zero.
bool normal_of(const int16_t* v, float normal[3]) {
  float length = 0;
  for (int a = 0; a < 3; ++a) {
    const int16_t after = v[kSteps[a]], before = v[-kSteps[a]];
    float slope = 0;
    if (seen(after) && seen(before)) slope = 0.5f * (after - before);
    else if (seen(after)) slope = static_cast<float>(after - v[0]);
    else if (seen(before)) slope = static_cast<float>(v[0] - before);
    normal[a] = slope;
    length += slope * slope;
  }
  const float scale = length > 0 ? 1 / std::sqrt(length) : 0.0f;
  for (int a = 0; a < 3; ++a) normal[a] *= scale;
  return length > 0;
}

// Mean of the crossings on the edges of voxel v that are nearer to it than to the neighbour; false if there are none.
bool point_of(const int16_t* v, float point[3]) {
  float sum[3] = {0, 0, 0};
  int n = 0;
  for (int a = 0; a < 3; ++a)
    for (int side = -1; side <= 1; side += 2) {
      const int16_t other = v[side * kSteps[a]];
      if (!seen(other) || (other < 0) == (v[0] < 0)) continue;
      const float t = static_cast<float>(v[0]) / static_cast<float>(v[0] - other);
      if (t > 0.5f || (t == 0.5f && side < 0)) continue;
      sum[a] += side * t;
      ++n;
    }
  for (int a = 0; a < 3; ++a) point[a] = n > 0 ? sum[a] / n : 0.0f;
  return n > 0;
}

// How far the disc of a site reaches before it stands out of the surface, as it would beyond a convex edge: where values
// on its rim tell of free space. `point` is the site's from its voxel v, `unit` turns values into voxels.
float radius_of(const int16_t* v, const float point[3], const float normal[3], float unit) {
  // Two directions across the normal.
  const int least = std::fabs(normal[0]) <= std::fabs(normal[1])
                        ? (std::fabs(normal[0]) <= std::fabs(normal[2]) ? 0 : 2)
                        : (std::fabs(normal[1]) <= std::fabs(normal[2]) ? 1 : 2);
  const int b = (least + 1) % 3, c = (least + 2) % 3;
  const float length = std::sqrt(normal[b] * normal[b] + normal[c] * normal[c]);
  float across[2][3] = {};
  across[0][b] = normal[c] / length, across[0][c] = -normal[b] / length;
  for (int a = 0; a < 3; ++a) {
    const int d = (a + 1) % 3, e = (a + 2) % 3;
    across[1][a] = normal[d] * across[0][e] - normal[e] * across[0][d];
  }
  float radius = kDiscRadius;
  for (int direction = 0; direction < 8; ++direction) {
    const float x = kRim[direction][0], y = kRim[direction][1];
    float beside = 0;  // of the voxel that the rim is in, in front of the disc's plane
    int step = 0;
    for (int a = 0; a < 3; ++a) {
      const float rim = point[a] + kDiscRadius * (x * across[0][a] + y * across[1][a]);
      const int place = rim > 0.5f ? 1 : rim < -0.5f ? -1 : 0;
      step += place * kSteps[a];
      beside += normal[a] * (static_cast<float>(place) - rim);
    }
    if (!seen(v[step])) continue;
    const float out = unit * v[step] - beside;
    if (out > kMayStandOut) radius = std::min(radius, kDiscRadius - (out - kMayStandOut));
  }
  // In steps, or the noise of values would change it with every view.
  return std::max(1.0f, std::floor(radius * (kRadiusSteps / kDiscRadius) + 0.5f)) * (kDiscRadius / kRadiusSteps);
}

}  // namespace

// Which of the 10 values of a row, halo and all, were seen and are negative: bits 0 ... 9.
struct RowBits {
  uint32_t seen, negative;
};

RowBits bits_of(const int16_t* row) {
  RowBits bits{0, 0};
#if defined(__SSE2__)
  const __m128i eight = _mm_loadu_si128(reinterpret_cast<const __m128i*>(row));
  const __m128i unseen = _mm_cmpeq_epi16(eight, _mm_set1_epi16(kUnseen));
  bits.seen = ~static_cast<uint32_t>(_mm_movemask_epi8(_mm_packs_epi16(unseen, unseen))) & 255;
  bits.negative = static_cast<uint32_t>(_mm_movemask_epi8(_mm_packs_epi16(eight, eight))) & 255;
  constexpr int kDone = 8;
#else
  constexpr int kDone = 0;
#endif
  for (int i = kDone; i < kHalo; ++i) {
    bits.seen |= static_cast<uint32_t>(seen(row[i])) << i;
    bits.negative |= static_cast<uint32_t>(row[i] < 0) << i;
  }
  return bits;
}

// Bits of the voxels of two neighbouring rows between which the sign changes.
uint32_t change(const RowBits& a, const RowBits& b) { return (a.negative ^ b.negative) & a.seen & b.seen; }

// Sites of the block in the middle of `values` [10, 10, 10] (x fastest; kUnseen where not seen, and in the corners and
// edges of the halo), `unit` voxels each; returns their number, at most 512. Known and negative voxels go to bit i + 8 j of
// word k.
int esdf_crossings(const int16_t* values, Site* out, uint64_t* known, uint64_t* negative, float unit) {
  RowBits rows[kHalo * kHalo];
  for (int row = 0; row < kHalo * kHalo; ++row) rows[row] = bits_of(values + row * kHalo);
  int n = 0;
  for (int k = 0; k < kSide; ++k) {
    known[k] = negative[k] = 0;
    for (int j = 0; j < kSide; ++j) {
      const RowBits* row = rows + (j + 1) + (k + 1) * kHalo;
      const uint64_t own = row->seen >> 1 & 255;
      known[k] |= own << (kSide * j);
      negative[k] |= (row->negative >> 1 & own) << (kSide * j);
      const uint32_t along = change(*row, {row->seen >> 1, row->negative >> 1});
      const uint32_t crossed = along | along << 1 | change(*row, row[-1]) | change(*row, row[1]) |
                               change(*row, row[-kHalo]) | change(*row, row[kHalo]);
      for (uint32_t left = crossed >> 1 & 255; left != 0; left &= left - 1) {
        const int i = __builtin_ctz(left);
        const int16_t* v = values + (i + 1) + (j + 1) * kHalo + (k + 1) * kHalo * kHalo;
        Site& site = out[n];
        if (!point_of(v, site.at)) continue;
        const int place[3] = {i, j, k};
        site.radius = normal_of(v, site.normal) ? radius_of(v, site.at, site.normal, unit) : 0.0f;
        for (int a = 0; a < 3; ++a) site.at[a] += static_cast<float>(place[a]);
        site.voxel = i + kSide * (j + kSide * k);
        ++n;
      }
    }
  }
  return n;
}

}  // namespace ggslam::GGSLAM_ISA
