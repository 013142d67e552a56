// SPDX-License-Identifier: Apache-2.0
// The surface within a voxel, from the zero crossings on the edges to its neighbours. Values v are those of the TSDF with
// kUnseen for none, of a grid of kHalo^3.
#pragma once
#include <cmath>

#include "native/formulas/formulas.hpp"
#include "native/formulas/site_rules.hpp"

namespace GGSLAM_FORMULAS {

// How far a rim may stand out of the surface, voxels: less is noise.
constexpr float kMayStandOut = 0.1f;
constexpr float kRadiusSteps = 8;

GGSLAM_FORMULA bool is_seen(std::int16_t value) { return value != volumes::kUnseen; }

// From a value to the next one along an axis.
GGSLAM_FORMULA int halo_step(int axis) { return axis == 0 ? 1 : axis == 1 ? volumes::kHalo : volumes::kHalo * volumes::kHalo; }

// Gradient of the values, central where both neighbours were seen; false if it is zero.
GGSLAM_FORMULA bool normal_of(const std::int16_t* v, float normal[3]) {
  float length = 0;
  for (int a = 0; a < 3; ++a) {
    const std::int16_t after = v[halo_step(a)], before = v[-halo_step(a)];
    float slope = 0;
    if (is_seen(after) && is_seen(before)) slope = 0.5f * (after - before);
    else if (is_seen(after)) slope = static_cast<float>(after - v[0]);
    else if (is_seen(before)) slope = static_cast<float>(v[0] - before);
    normal[a] = slope;
    length += slope * slope;
  }
  const float scale = length > 0 ? 1 / std::sqrt(length) : 0.0f;
  for (int a = 0; a < 3; ++a) normal[a] *= scale;
  return length > 0;
}

// Mean of the crossings on the edges of voxel v that are nearer to it than to the neighbour; false if there are none.
GGSLAM_FORMULA bool point_of(const std::int16_t* v, float point[3]) {
  float sum[3] = {0, 0, 0};
  int n = 0;
  for (int a = 0; a < 3; ++a)
    for (int side = -1; side <= 1; side += 2) {
      const std::int16_t other = v[side * halo_step(a)];
      if (!is_seen(other) || (other < 0) == (v[0] < 0)) continue;
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
GGSLAM_FORMULA float radius_of(const std::int16_t* v, const float point[3], const float normal[3], float unit) {
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
  constexpr float kHalfRoot = 0.70710678f;
  constexpr float kRim[8][2] = {{1, 0}, {-1, 0}, {0, 1}, {0, -1}, {kHalfRoot, kHalfRoot}, {-kHalfRoot, kHalfRoot},
                                {kHalfRoot, -kHalfRoot}, {-kHalfRoot, -kHalfRoot}};
  float radius = volumes::kDiscRadius;
  for (int direction = 0; direction < 8; ++direction) {
    const float x = kRim[direction][0], y = kRim[direction][1];
    float beside = 0;  // of the voxel that the rim is in, in front of the disc's plane
    int step = 0;
    for (int a = 0; a < 3; ++a) {
      const float rim = point[a] + volumes::kDiscRadius * (x * across[0][a] + y * across[1][a]);
      const int place = rim > 0.5f ? 1 : rim < -0.5f ? -1 : 0;
      step += place * halo_step(a);
      beside += normal[a] * (static_cast<float>(place) - rim);
    }
    if (!is_seen(v[step])) continue;
    const float out = unit * v[step] - beside;
    if (out > kMayStandOut) radius = smaller_of(radius, volumes::kDiscRadius - (out - kMayStandOut));
  }
  // In steps, or the noise of values would change it with every view.
  return larger_of(1.0f, std::floor(radius * (kRadiusSteps / volumes::kDiscRadius) + 0.5f)) * (volumes::kDiscRadius / kRadiusSteps);
}

// How far two discs are from each other at most.
GGSLAM_FORMULA float disc_shift(const float a[3], const float normal_a[3], float radius_a, const float b[3],
                                const float normal_b[3], float radius_b) {
  const float x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
  const float u = normal_a[0] - normal_b[0], v = normal_a[1] - normal_b[1], w = normal_a[2] - normal_b[2];
  return std::sqrt(x * x + y * y + z * z) + larger_of(radius_a, radius_b) * std::sqrt(u * u + v * v + w * w) +
         std::fabs(radius_a - radius_b);
}

}  // namespace GGSLAM_FORMULAS
