// SPDX-License-Identifier: Apache-2.0
// Surface points of a block of the TSDF: zero crossings on the edges between voxels.
#include <cmath>

#include "volumes/esdf_types.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

using namespace ggslam::volumes;

constexpr int kSteps[3] = {1, kHalo, kHalo * kHalo};

bool seen(int16_t value) { return value != kUnseen; }

// Gradient of the values, central where both neighbours were seen.
void normal_of(const int16_t* v, float normal[3]) {
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

}  // namespace

// Sites of the block in the middle of `values` [10, 10, 10] (x fastest; kUnseen where not seen; the corners and edges of
// the halo are not read); returns their number, at most 512. Known and negative voxels go to bit i + 8 j of word k.
int esdf_crossings(const int16_t* values, Site* out, uint64_t* known, uint64_t* negative) {
  int n = 0;
  for (int k = 0; k < kSide; ++k) {
    known[k] = negative[k] = 0;
    for (int row = 0; row < kSide * kSide; ++row) {
      const int16_t* v = values + (row % kSide + 1) + (row / kSide + 1) * kHalo + (k + 1) * kHalo * kHalo;
      if (!seen(*v)) continue;
      known[k] |= uint64_t{1} << row;
      if (*v < 0) negative[k] |= uint64_t{1} << row;
      Site& site = out[n];
      if (!point_of(v, site.point)) continue;
      normal_of(v, site.normal);
      site.voxel = row + kSide * kSide * k;
      ++n;
    }
  }
  return n;
}

}  // namespace ggslam::GGSLAM_ISA
