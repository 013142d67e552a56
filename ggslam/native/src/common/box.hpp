// SPDX-License-Identifier: Apache-2.0
// Boxes of whole coordinates: voxels or blocks.
#pragma once
#include <cstdint>
#include <limits>

#include "common/vector.hpp"

namespace ggslam {

// Half-open.
struct Box3i {
  Vec3i low, high;

  // The box of nothing, to include things in.
  static constexpr Box3i empty() {
    constexpr int kMost = std::numeric_limits<int>::max();
    return {Vec3i::all(kMost), Vec3i::all(-kMost)};
  }
  static constexpr Box3i at(const Vec3i& first, int side = 1) { return {first, first + Vec3i::all(side)}; }

  constexpr bool is_empty() const { return low[0] >= high[0] || low[1] >= high[1] || low[2] >= high[2]; }
  constexpr std::int64_t size(int axis) const { return std::int64_t{high[axis]} - low[axis]; }
  constexpr bool contains(const Vec3i& p) const { return contains(at(p)); }
  constexpr bool contains(const Box3i& b) const { return min(low, b.low) == low && max(high, b.high) == high; }
  constexpr bool intersects(const Box3i& b) const { return !intersection(*this, b).is_empty(); }

  constexpr void include(const Box3i& b) { low = min(low, b.low), high = max(high, b.high); }
  constexpr Box3i grow(int by) const { return {low - Vec3i::all(by), high + Vec3i::all(by)}; }
  constexpr Box3i shift(const Vec3i& by) const { return {low + by, high + by}; }
  // Of blocks of so many voxels along an edge, their voxels.
  constexpr Box3i scale(int by) const { return {by * low, by * high}; }

  friend constexpr Box3i intersection(const Box3i& a, const Box3i& b) { return {max(a.low, b.low), min(a.high, b.high)}; }
};

}  // namespace ggslam
