// SPDX-License-Identifier: Apache-2.0
// Places of one view in another: where they fall, and what that says of them.
#include <algorithm>

#include "sight/places.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

constexpr float kNearest = 1e-3f;  // metres before the camera
constexpr float kRounding = 0.999f;  // a margin that rounding does not make larger than another one

}  // namespace

void project_places(const PlacesView& view, const OtherPlacesView& other_, const ProjectedPlaces& places) {
  // Copies, which nothing that is written can be a part of: the compiler takes many places at once.
  const PlacesView a = view;
  const OtherPlacesView other = other_;
  const ProjectedPlaces out = places;
  const PlacesView& b = other.places;
  const float* T = other.T_this_view;
  const float right = static_cast<float>(b.width) - 0.5f, low = static_cast<float>(b.height) - 0.5f;
  for (int y = 0; y < a.height; ++y) {
    const std::size_t first = static_cast<std::size_t>(y) * a.width;
    const float* depth = a.depth + first;
    float* u = out.u + first;
    float* v = out.v + first;
    float* z = out.z + first;
    int* where = out.where + first;
    const float ray_y = (static_cast<float>(y) - a.cy) / a.fy;
    for (int x = 0; x < a.width; ++x) {
      const float d = depth[x], px = (static_cast<float>(x) - a.cx) / a.fx * d, py = ray_y * d;
      const float qx = T[0] * px + T[1] * py + T[2] * d + T[3], qy = T[4] * px + T[5] * py + T[6] * d + T[7];
      const float qz = T[8] * px + T[9] * py + T[10] * d + T[11], ahead = qz > kNearest ? qz : kNearest;
      const float column = b.fx * qx / ahead + b.cx, line = b.fy * qy / ahead + b.cy;
      const bool inside =
          (d > 0) & (qz > kNearest) & (column >= -0.5f) & (line >= -0.5f) & (column < right) & (line < low);
      u[x] = column, v[x] = line, z[x] = qz;
      // What is outside may be too large for a whole number.
      const int i = static_cast<int>(inside ? line + 0.5f : 0.f), j = static_cast<int>(inside ? column + 0.5f : 0.f);
      where[x] = inside ? i * b.width + j : -1;
    }
  }
}

void look_up_places(const PlacesView& a, const PlacesView& b, const ProjectedPlaces& out) {
  const std::size_t count = static_cast<std::size_t>(a.height) * a.width;
  for (std::size_t i = 0; i < count; ++i) {
    const int at = out.where[i] < 0 ? 0 : out.where[i];
    out.near[i] = b.near[at], out.far[i] = b.far[at];
    out.known[i] = (out.where[i] >= 0) & (b.whole[at] != 0);
    out.smooth[i] = out.known[i] & (b.smooth[at] != 0) & (a.smooth[i] != 0);
  }
}

void flag_perhaps_passed(const PlacesRule& rule, const PlacesView& a, const float* beyond,
                         const ProjectedPlaces& places, uint8_t* flags) {
  const SightMargin margin = rule.margin;  // copies: what is written may not change them
  const ProjectedPlaces out = places;
  const uint8_t* smooth = a.smooth;
  const std::size_t count = static_cast<std::size_t>(a.height) * a.width;
  const float least = kRounding * std::min(rule.least_share, rule.rough), rough = kRounding * rule.rough;
  for (std::size_t i = 0; i < count; ++i) out.near[i] = out.where[i] < 0 ? 0.f : beyond[out.where[i]];
  for (std::size_t i = 0; i < count; ++i) {
    const float z = out.z[i], slack = kRounding * margin_at(margin, z, smooth[i] ? least : rough);
    flags[i] = (z > 0) & (out.near[i] > z + slack);
  }
}

void judge_places(const PlacesRule& rule, float share, std::size_t count, const ProjectedPlaces& places,
                  uint8_t* found) {
  const SightMargin margin = rule.margin;  // a copy: what is written may not change it
  uint8_t* passed = found;
  uint8_t* clearly = passed + count;
  uint8_t* surely = clearly + count;
  uint8_t* same = surely + count;
  uint8_t* otherwise = same + count;
  for (std::size_t i = 0; i < count; ++i) {
    const float z = places.z[i], near = places.near[i], far = places.far[i];
    const float slack = margin_at(margin, z, places.smooth[i] ? share : rule.rough);
    const uint8_t known = places.known[i], there = places.where[i] >= 0;
    const uint8_t beyond = known & (near > z + 2 * slack);
    const uint8_t surface = there & (near < z + slack) & (far > z - slack);
    passed[i] = known & (near > z + slack);
    clearly[i] = beyond;
    surely[i] = beyond & places.smooth[i];
    same[i] = surface;
    otherwise[i] = known & (surface ^ 1);
  }
}

}  // namespace ggslam::GGSLAM_ISA
