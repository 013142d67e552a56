// SPDX-License-Identifier: Apache-2.0
// Points to grid, and along which axis they are cut into slices. One pass each, without temporaries: pages that are new
// to the process cost more than the arithmetic, and this is the part of coding that workers do not share.
// No product may be fused with a sum here (see CMakeLists.txt): a point has the same voxel on every machine.
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "common/context.hpp"

namespace ggslam::gpcc {

// clip(floor(scale p + rounding), first, last) - first. Mirrored in ggslam/coding/native.py.
struct Grid {
  double scale, rounding;
  std::int64_t first[3], last[3];
  std::int32_t exact;  // coordinates are integers and stand for themselves
};

// Points [*, 3] of which `rows` [count] are meant; without rows, the first `count`.
struct Points {
  const void* data;
  const std::int64_t* rows;
  std::size_t count;
  std::int32_t kind;  // 0: int32, 1: int64, 2: float, 3: double
};

namespace {

template <class Value>
std::int32_t coordinate(const Grid& grid, int axis, Value value) {
  const std::int64_t first = grid.first[axis], last = grid.last[axis];
  if (grid.exact) {
    const std::int64_t whole = static_cast<std::int64_t>(value);
    return static_cast<std::int32_t>(std::min(std::max(whole, first), last) - first);
  }
  const double whole = std::floor(static_cast<double>(value) * grid.scale + grid.rounding);
  const double low = static_cast<double>(first), high = static_cast<double>(last);
  return static_cast<std::int32_t>(std::min(std::max(whole, low), high) - low);
}

// visit(index, point) for every point, whatever its type.
template <class Value, class Visit>
void each(const Points& points, const Visit& visit) {
  const Value* data = static_cast<const Value*>(points.data);
  for (std::size_t i = 0; i < points.count; ++i) visit(i, data + 3 * (points.rows ? points.rows[i] : i));
}

template <class Visit>
void for_each_point(const Points& points, const Visit& visit) {
  switch (points.kind) {
    case 0: return each<std::int32_t>(points, visit);
    case 1: return each<std::int64_t>(points, visit);
    case 2: return each<float>(points, visit);
    default: return each<double>(points, visit);
  }
}

}  // namespace
}  // namespace ggslam::gpcc

using namespace ggslam::gpcc;

// Grid positions [count, 3].
GGSLAM_EXPORT void ggslam_gpcc_on_grid(const Points* points, const Grid* grid, std::int32_t* out) {
  for_each_point(*points, [&](std::size_t i, const auto* p) {
    for (int axis = 0; axis < 3; ++axis) out[3 * i + axis] = coordinate(*grid, axis, p[axis]);
  });
}

// Grid coordinates [count] along one axis.
GGSLAM_EXPORT void ggslam_gpcc_along_axis(const Points* points, const Grid* grid, std::int32_t axis, std::int32_t* out) {
  for_each_point(*points, [&](std::size_t i, const auto* p) { out[i] = coordinate(*grid, axis, p[axis]); });
}

// Adds to counts [planes] the number of points in each plane across an axis.
GGSLAM_EXPORT void ggslam_gpcc_plane_counts(const Points* points, const Grid* grid, std::int32_t axis,
                                            std::uint32_t* counts) {
  for_each_point(*points, [&](std::size_t, const auto* p) { ++counts[coordinate(*grid, axis, p[axis])]; });
}

// numbers [count] become number_of_plane[coordinate]. The indices of points in planes that are marked as cut are appended
// to `inside`, which has room for them.
GGSLAM_EXPORT void ggslam_gpcc_number_planes(const Points* points, const Grid* grid, std::int32_t axis,
                                             const std::uint16_t* number_of_plane, const std::uint8_t* cut,
                                             std::uint16_t* numbers, std::int64_t* inside) {
  for_each_point(*points, [&](std::size_t i, const auto* p) {
    const std::int32_t plane = coordinate(*grid, axis, p[axis]);
    numbers[i] = number_of_plane[plane];
    if (cut[plane]) *inside++ = static_cast<std::int64_t>(i);
  });
}

// Appends to `codes`, which has room for count of them, the points in cubes of an edge of 2^cube_bits voxels that a hash
// chooses: one slab across x in slab_mask + 1, and of its cubes one in cube_mask + 1 (powers of two). Most points are
// passed over by one coordinate. A code has 21 bits a coordinate. Returns how many there are.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_sample_cubes(const Points* points, const Grid* grid, std::int32_t cube_bits,
                                                    std::uint32_t slab_mask, std::uint32_t cube_mask,
                                                    std::uint64_t* codes) {
  const auto hash = [](std::uint64_t v) { return (v + 1) * 0x9e3779b97f4a7c15ull >> 40; };
  std::uint64_t* end = codes;
  for_each_point(*points, [&](std::size_t, const auto* p) {
    const auto x = static_cast<std::uint64_t>(coordinate(*grid, 0, p[0]));
    if ((hash(x >> cube_bits) & slab_mask) != 0) return;
    const auto y = static_cast<std::uint64_t>(coordinate(*grid, 1, p[1]));
    const auto z = static_cast<std::uint64_t>(coordinate(*grid, 2, p[2]));
    if ((hash((y >> cube_bits) << 21 | z >> cube_bits) & cube_mask) != 0) return;
    *end++ = x << 42 | y << 21 | z;
  });
  return end - codes;
}
