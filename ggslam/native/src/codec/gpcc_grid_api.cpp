// SPDX-License-Identifier: Apache-2.0
// Points to grid, and along which axis they are cut into slices. One pass each, without temporaries: pages that are new
// to the process cost more than the arithmetic, and this is the part of coding that workers do not share.
// No product may be fused with a sum here (see CMakeLists.txt): a point has the same voxel on every machine.
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "abi/core/codec.hpp"

namespace ggslam::gpcc {
namespace {

template <class Value>
std::int32_t coordinate(const Grid& grid, int axis, Value value) {
  const std::int64_t first = grid.first[axis], last = grid.last[axis];
  if (grid.exact) {
    const std::int64_t whole = static_cast<std::int64_t>(value);
    return static_cast<std::int32_t>(std::min(std::max(whole, first), last) - first);
  }
  // In this order, what is no number becomes the lowest coordinate.
  const double whole = std::floor(static_cast<double>(value) * grid.scale + grid.rounding);
  const double low = static_cast<double>(first), high = static_cast<double>(last);
  return static_cast<std::int32_t>(std::min(std::max(low, whole), high) - low);
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

const Points& check_points(const Points* pointer) {
  const Points& points = object_of<Points>(pointer);
  check_range("kind", points.kind, 0, 3);
  check_array("points", points.data, static_cast<std::int64_t>(elements(static_cast<std::int64_t>(points.count))));
  return points;
}

const Grid& check_grid(const Grid* pointer, int axis = 0) {
  const Grid& grid = object_of<Grid>(pointer);
  check_range("axis", axis, 0, 2);
  check_within("scale", &grid.scale, 1, 1e300), check_within("rounding", &grid.rounding, 1, 1e300);
  for (int a = 0; a < 3; ++a) {
    // Doubles hold all whole numbers up to 2^52; where no doubles are in between, nothing may overflow.
    const std::int64_t most = std::int64_t{1} << (grid.exact ? 62 : 52);
    check_range("first", grid.first[a], -most, most);
    check_range("last", grid.last[a], grid.first[a], grid.first[a] + std::numeric_limits<std::int32_t>::max());
  }
  return grid;
}

}  // namespace
}  // namespace ggslam::gpcc

using namespace ggslam;
using namespace ggslam::gpcc;

GGSLAM_EXPORT int ggslam_gpcc_on_grid(const Points* points, const Grid* grid, std::int32_t* out) try {
  check_grid(grid);
  check_array("out", out, static_cast<std::int64_t>(check_points(points).count));
  for_each_point(*points, [&](std::size_t i, const auto* p) {
    for (int axis = 0; axis < 3; ++axis) out[3 * i + axis] = coordinate(*grid, axis, p[axis]);
  });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gpcc_along_axis(const Points* points, const Grid* grid, std::int32_t axis, std::int32_t* out) try {
  check_grid(grid, axis);
  check_array("out", out, static_cast<std::int64_t>(check_points(points).count));
  for_each_point(*points, [&](std::size_t i, const auto* p) { out[i] = coordinate(*grid, axis, p[axis]); });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gpcc_plane_counts(const Points* points, const Grid* grid, std::int32_t axis,
                                           std::uint32_t* counts) try {
  check_grid(grid, axis);
  check_array("counts", counts, static_cast<std::int64_t>(check_points(points).count));
  for_each_point(*points, [&](std::size_t, const auto* p) { ++counts[coordinate(*grid, axis, p[axis])]; });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gpcc_number_planes(const Points* points, const Grid* grid, std::int32_t axis,
                                            const std::uint16_t* number_of_plane, const std::uint8_t* cut,
                                            std::uint16_t* numbers, std::int64_t* inside) try {
  check_grid(grid, axis);
  const auto count = static_cast<std::int64_t>(check_points(points).count);
  check_array("number_of_plane", number_of_plane, count), check_array("cut", cut, count);
  check_array("numbers", numbers, count), check_array("inside", inside, count);
  for_each_point(*points, [&](std::size_t i, const auto* p) {
    const std::int32_t plane = coordinate(*grid, axis, p[axis]);
    numbers[i] = number_of_plane[plane];
    if (cut[plane]) *inside++ = static_cast<std::int64_t>(i);
  });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_sample_cubes(const Points* points, const Grid* grid, std::int32_t cube_bits,
                                                    std::uint32_t slab_mask, std::uint32_t cube_mask,
                                                    std::uint64_t* codes) try {
  check_grid(grid);
  check_array("codes", codes, static_cast<std::int64_t>(check_points(points).count));
  check_range("cube_bits", cube_bits, 0, 21);
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
} GGSLAM_CATCH_ALL
