// SPDX-License-Identifier: Apache-2.0
// From the nearest voxel with a site to the distance from the surface.
#include <algorithm>
#include <cmath>
#include <limits>

#include "volumes/esdf_types.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

using namespace ggslam::volumes;

struct Foot {
  float distance;     // unsigned
  float gradient[3];  // of the signed distance
};

// The search for the nearest points of the voxels of a row, all at once.
//
// The nearest centre need not belong to the nearest point: on an oblique plane, centres lie up to half a voxel in front
// of it or behind, which at a distance d outweighs a shift of sqrt(d) along it. From the sites with the nearest centres,
// each voxel goes over to neighbouring sites while that comes nearer. Every site met is offered to the whole row.
class Row {
 public:
  Row(const RefineInput& in, const int first[3]) : in_(in) { std::copy_n(first, 3, v_); }

  // The nearest site of voxel i, after the search.
  int32_t site(int i) const { return site_[i]; }

  // `starts`: sites with the nearest centres; `active`: bits of the voxels to search for.
  void search(const int32_t* starts, unsigned active) {
    for (int i = 0; i < kSide; ++i)
      if (active >> i & 1 && (i == 0 || starts[i] != starts[i - 1] || !(active >> (i - 1) & 1))) offer(starts[i]);
    for (bool found = true; found;) {
      found = false;
      for (int i = 0; i < kSide; ++i) {
        const int32_t number = site_[i];
        if (!(active >> i & 1) || was_spread(number)) continue;
        spread_[spreads_++ % kRemembered] = number;
        const int32_t* list = in_.neighbours + in_.sites[number].neighbours;
        for (int n = 0; n < in_.sites[number].neighbour_count; ++n) offer(list[n]);
        found = true;
      }
    }
  }

 private:
  // One lane for each voxel. The compiler does not vectorise the choice of the nearer one by itself.
  typedef float Lanes __attribute__((vector_size(4 * kSide)));
  typedef int32_t IntLanes __attribute__((vector_size(4 * kSide)));
  static constexpr int kRemembered = 32;

  const RefineInput& in_;
  int v_[3];  // first voxel
  Lanes square_ = Lanes{} + std::numeric_limits<float>::max();  // to the nearest point so far
  IntLanes site_ = IntLanes{} - 1;
  int32_t spread_[kRemembered];  // sites whose neighbours were offered, the last ones
  int spreads_ = 0;

  void offer(int32_t number) {
    const BoxSite& s = in_.sites[number];
    const float x = static_cast<float>(v_[0] - s.cell.x), y = static_cast<float>(v_[1] - s.cell.y) - s.point[1],
                z = static_cast<float>(v_[2] - s.cell.z) - s.point[2];
    const Lanes along = (Lanes{0, 1, 2, 3, 4, 5, 6, 7} + x) - s.point[0];
    const Lanes square = along * along + (y * y + z * z);
    const IntLanes nearer = square < square_;
    square_ = nearer ? square : square_;
    site_ = nearer ? IntLanes{} + number : site_;
  }

  bool was_spread(int32_t number) const {
    for (int i = std::min(spreads_, kRemembered); i-- > 0;)
      if (spread_[i] == number) return true;
    return false;
  }
};

// From a site's point to a voxel's centre.
void difference(const BoxSite& s, const int v[3], float from[3]) {
  from[0] = static_cast<float>(v[0] - s.cell.x) - s.point[0];
  from[1] = static_cast<float>(v[1] - s.cell.y) - s.point[1];
  from[2] = static_cast<float>(v[2] - s.cell.z) - s.point[2];
}

// The nearest point of a site's tangent disc.
Foot foot_on(const BoxSite& s, const int v[3], bool behind) {
  float from[3], height = 0, normal_length = 0;
  difference(s, v, from);
  for (int a = 0; a < 3; ++a) {
    height += from[a] * s.normal[a];
    normal_length += s.normal[a] * s.normal[a];
  }
  float along[3], square = 0;
  for (int a = 0; a < 3; ++a) along[a] = from[a] - height * s.normal[a], square += along[a] * along[a];
  const float radius = normal_length > 0 ? kDiscRadius : 0.0f, length = std::sqrt(square);
  const float sign = behind ? -1.0f : 1.0f;
  Foot foot;
  if (length <= radius) {
    foot.distance = std::fabs(height);
    // So close to the surface, the side that the value tells and that of the disc may differ.
    const float direction = foot.distance < 0.5f || (height < 0) == behind ? 1.0f : -1.0f;
    for (int a = 0; a < 3; ++a) foot.gradient[a] = direction * s.normal[a];
    return foot;
  }
  const float outside = (length - radius) / length;
  float distance = height * height;
  for (int a = 0; a < 3; ++a) distance += outside * along[a] * outside * along[a];
  foot.distance = std::sqrt(distance);
  const float scale = sign / std::max(foot.distance, 1e-6f);
  for (int a = 0; a < 3; ++a) foot.gradient[a] = scale * (height * s.normal[a] + outside * along[a]);
  return foot;
}

float centre_distance(SiteCell cell, const int v[3]) {
  const int x = v[0] - cell.x, y = v[1] - cell.y, z = v[2] - cell.z;
  return std::sqrt(static_cast<float>(x * x + y * y + z * z));
}

uint32_t packed(const float g[3]) {
  uint32_t bits = 0;
  for (int a = 0; a < 3; ++a)
    bits |= static_cast<uint32_t>(std::min(std::max(g[a], -1.0f), 1.0f) * 511.0f + 511.5f) << (10 * a);
  return bits;
}

float margin(const RefineInput& in, const int v[3]) {
  int least = std::numeric_limits<int>::max();
  for (int a = 0; a < 3; ++a) least = std::min({least, v[a] - in.low[a] + 1, in.high[a] - v[a]});
  return static_cast<float>(least);
}

}  // namespace

RefineOutput esdf_refine(const RefineInput& in, FieldVoxels& out) {
  RefineOutput result{0, -1};
  constexpr uint32_t kNoGradient = 511u | 511u << 10 | 511u << 20;
  // Beyond this, no point can be within the largest distance.
  const float farthest = in.max_distance + kCentreSlack;
  for (int line = 0; line < kSide * kSide; ++line) {
    const int j = line % kSide, k = line / kSide;
    const int32_t* starts = in.nearest + j * in.stride_y + k * in.stride_z;
    const int first[3] = {in.origin[0], in.origin[1] + j, in.origin[2] + k};
    const unsigned known = in.known[k] >> (kSide * j) & 255, negative = in.negative[k] >> (kSide * j) & 255;
    unsigned active = 0;
    for (int i = 0; i < kSide; ++i) {
      if (!(known >> i & 1)) continue;
      const int v[3] = {first[0] + i, first[1], first[2]};
      float centre = farthest;
      if (starts[i] >= 0) centre = std::min(centre_distance(in.cells[starts[i]], v), farthest);
      if (centre < farthest) active |= 1u << i;
      result.required = std::max(result.required, centre + kReading);
      result.missing = std::max(result.missing, centre + kReading - margin(in, v));
    }
    Row row(in, first);
    row.search(starts, active);
    for (int i = 0; i < kSide; ++i) {
      const int v[3] = {first[0] + i, first[1], first[2]};
      const bool behind = negative >> i & 1;
      float distance = known >> i & 1 ? in.max_distance : std::numeric_limits<float>::quiet_NaN();
      uint32_t gradient = kNoGradient;
      if (active >> i & 1) {
        const Foot foot = foot_on(in.sites[row.site(i)], v, behind);
        if (foot.distance < in.max_distance) distance = foot.distance, gradient = packed(foot.gradient);
      }
      out.distance[kSide * line + i] = (behind ? -distance : distance) * in.voxel;
      out.gradient[kSide * line + i] = gradient;
    }
  }
  return result;
}

}  // namespace ggslam::GGSLAM_ISA
