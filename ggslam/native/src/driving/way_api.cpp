// SPDX-License-Identifier: Apache-2.0
// The planner as seen from outside.
#include <algorithm>
#include <cmath>
#include <limits>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "driving/clear_line.hpp"
#include "driving/way_search.hpp"
#include "driving/way_smoothing.hpp"

GGSLAM_DECLARE_KERNEL(void distances_along_line(const uint8_t* occupied, int width, int reach, float* squared))
GGSLAM_DECLARE_KERNEL(void distances_across_lines(const float* squared, std::ptrdiff_t stride, int count, int own,
                                                  int width, int reach, float* out))

using namespace ggslam;
using namespace ggslam::driving;

namespace {

using Points = std::vector<Vec3<double>>;

constexpr int kMostPage = 1 << 16;   // blocks
constexpr int kMostReach = 1 << 12;  // cells
constexpr double kFarthestPoint = 1e9;

// A grid, the search on it, and the path that was smoothed last.
struct Planner {
  WayGrid grid;
  WaySearch search;
  Points smoothed;
  bool begun = false;
  Planner(int dimensions, double cell, int page) : grid(dimensions, cell, page), search(grid) {}
};

Planner& planner(void* handle) { return object_of<Planner>(handle); }

Vec3i vector3(const char* name, const int32_t* v) {
  check_array(name, v, 3);
  return Vec3i::from(v);
}

// The box's cells have coordinates; how many they are.
std::size_t check_box(const Planner& p, const Vec3i& low, const Vec3i& shape) {
  for (int a = 0; a < 3; ++a) {
    check_range("box", static_cast<double>(low[a]), -static_cast<double>(kFarthestCell), static_cast<double>(kFarthestCell));
    check_range("box", shape[a], 0, static_cast<int>(kFarthestCell));
  }
  if (p.grid.dimensions == 2 && (low[2] != 0 || shape[2] != 1)) refuse("box: expected one layer at z = 0");
  return elements(shape[0], shape[1], shape[2]);
}

Points points_of(const Planner& p, int64_t n, const double* points) {
  check_array("points", points, n);
  Points out(elements(n));
  for (std::size_t i = 0; i < out.size(); ++i) out[i] = p.grid.to_cells(points + 3 * i);
  return out;
}

void copy_points(const Planner& p, const Points& from, int64_t n, double* points) {
  check_array("points", points, n);
  if (n != static_cast<int64_t>(from.size())) refuse("points: expected %zu, found %lld", from.size(), static_cast<long long>(n));
  for (std::size_t i = 0; i < from.size(); ++i) p.grid.to_metres(from[i], points + 3 * i);
}

}  // namespace

GGSLAM_EXPORT void* ggslam_way_grid_create(int dimensions, double cell, int page) try {
  check_range("dimensions", dimensions, 2, 3), check_range("cell", cell, 1e-4, 1e3), check_range("page", page, 0, kMostPage);
  return new Planner(dimensions, cell, page);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_way_grid_destroy(void* handle) try {
  delete static_cast<Planner*>(handle);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int64_t ggslam_way_grid_bytes(void* handle) try {
  return static_cast<int64_t>(planner(handle).grid.bytes() + planner(handle).search.bytes());
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_way_grid_write(void* handle, const int32_t* low_, const int32_t* shape_,
                                        const float* clearance, int lower) try {
  Planner& p = planner(handle);
  const Vec3i low = vector3("low", low_), shape = vector3("shape", shape_);
  check_array("clearance", clearance, static_cast<int64_t>(check_box(p, low, shape)));
  if (lower == 0) p.grid.forget();
  p.grid.write(low, shape, clearance);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_way_grid_read(void* handle, const int32_t* low_, const int32_t* shape_, float* clearance) try {
  Planner& p = planner(handle);
  const Vec3i low = vector3("low", low_), shape = vector3("shape", shape_);
  check_array("clearance", clearance, static_cast<int64_t>(check_box(p, low, shape)));
  p.grid.read(low, shape, clearance);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_way_grid_finish_page(void* handle, const int32_t* page) try {
  const Vec3i at = vector3("page", page);
  planner(handle).grid.finish_page({at[0], at[1], at[2]});
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_way_grid_query(void* handle, int64_t n, const double* points, float* clearance,
                                        float* gradient) try {
  Planner& p = planner(handle);
  const Points places = points_of(p, n, points);
  check_array("clearance", clearance, n);
  CellReader reader(p.grid);
  for (std::size_t i = 0; i < places.size(); ++i) {
    double slope[3] = {0, 0, 0};
    clearance[i] = static_cast<float>(p.grid.cell) * reader.interpolate(places[i], gradient ? slope : nullptr);
    for (int a = 0; gradient != nullptr && a < 3; ++a) gradient[3 * i + a] = static_cast<float>(slope[a]);
  }
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_way_grid_least(void* handle, int64_t n, const double* points, float* least) try {
  Planner& p = planner(handle);
  const Points places = points_of(p, n, points);
  check_array("least", least, std::max<int64_t>(0, n - 1));
  CellReader reader(p.grid);
  for (std::size_t i = 0; i + 1 < places.size(); ++i)
    least[i] = static_cast<float>(p.grid.cell) * least_clearance(reader, places[i], places[i + 1]);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_way_begin(void* handle, const WayQuery* query_) try {
  Planner& p = planner(handle);
  const WayQuery& query = object_of<WayQuery>(query_);
  check_within("start", query.start, 3, kFarthestPoint), check_within("goal", query.goal, 3, kFarthestPoint);
  check_range("radius", query.radius, 0.0f, 1e6f), check_range("margin", query.margin, 0.0f, 1e6f);
  check_range("weight", query.weight, 0.0f, 1e6f);
  p.search.begin(query);
  p.begun = true;
  return kSearching;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_way_search(void* handle, int64_t most, WayStats* stats) try {
  Planner& p = planner(handle);
  WayStats& out = object_of<WayStats>(stats);
  if (!p.begun) refuse("search: none was begun");
  const SearchState state = p.search.go_on(most);
  out = p.search.stats();
  return state;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_way_points(void* handle, int64_t n, double* points) try {
  Planner& p = planner(handle);
  copy_points(p, p.search.points(), n, points);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int64_t ggslam_way_smooth(void* handle, int64_t n, const double* points,
                                        const SmoothingSettings* settings_) try {
  Planner& p = planner(handle);
  const SmoothingSettings& settings = object_of<SmoothingSettings>(settings_);
  check_range("points", n, int64_t{1}, int64_t{1} << 32), check_range("passes", settings.passes, 0, 1 << 20);
  check_range("spacing", settings.spacing, static_cast<float>(p.grid.cell / 100), 1e9f);
  check_range("radius", settings.radius, 0.0f, 1e6f), check_range("margin", settings.margin, 0.0f, 1e6f);
  check_range("weight", settings.weight, 0.0f, 1e6f), check_range("push", settings.push, 0.0f, 1e3f);
  check_range("most_length", settings.most_length, 0.0f, 1e9f);
  p.smoothed = pull_tight(p.grid, points_of(p, n, points), settings);
  if (settings.passes > 0) p.smoothed = smooth(p.grid, p.smoothed, settings);
  return static_cast<int64_t>(p.smoothed.size());
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_way_smooth_points(void* handle, int64_t n, double* points) try {
  Planner& p = planner(handle);
  copy_points(p, p.smoothed, n, points);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_cell_distances(void* context_, const int32_t* shape_, const uint8_t* occupied, float cell,
                                        int reach, float* distance) try {
  Context& context = object_of<Context>(context_);
  const Vec3i shape = vector3("shape", shape_);
  for (int a = 0; a < 3; ++a) check_range("shape", shape[a], 0, 1 << 24);
  const std::size_t n = elements(shape[0], shape[1], shape[2]);
  check_array("occupied", occupied, static_cast<int64_t>(n)), check_array("distance", distance, static_cast<int64_t>(n));
  check_range("cell", cell, 1e-4f, 1e3f), check_range("reach", reach, 1, kMostReach);
  const std::size_t width = static_cast<std::size_t>(shape[0]), layer = width * static_cast<std::size_t>(shape[1]);
  const std::size_t lines = n == 0 ? 0 : n / width;
  const auto along = GGSLAM_DISPATCH(context.isa, distances_along_line);
  const auto across = GGSLAM_DISPATCH(context.isa, distances_across_lines);
  std::vector<float> held(n);
  context.pool.parallel_for(lines, 64, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t l = begin; l < end; ++l) along(occupied + l * width, shape[0], reach, held.data() + l * width);
  });
  context.pool.parallel_for(lines, 16, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t l = begin; l < end; ++l) {
      const std::size_t z = l / static_cast<std::size_t>(shape[1]), y = l % static_cast<std::size_t>(shape[1]);
      across(held.data() + z * layer, static_cast<std::ptrdiff_t>(width), shape[1], static_cast<int>(y), shape[0], reach,
             distance + l * width);
    }
  });
  const float most = static_cast<float>(reach);
  held.assign(distance, distance + n);
  context.pool.parallel_for(lines, 16, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t l = begin; l < end; ++l) {
      const std::size_t z = l / static_cast<std::size_t>(shape[1]), y = l % static_cast<std::size_t>(shape[1]);
      float* out = distance + l * width;
      across(held.data() + y * width, static_cast<std::ptrdiff_t>(layer), shape[2], static_cast<int>(z), shape[0], reach, out);
      for (std::size_t x = 0; x < width; ++x) out[x] = cell * std::min(most, std::sqrt(out[x]));
    }
  });
  return 0;
} GGSLAM_CATCH_ALL
