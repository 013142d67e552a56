// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstring>
#include <limits>

#include "common/buffer.hpp"
#include "common/context.hpp"
#include "common/guard.hpp"
#include "volumes/occupancy_files.hpp"
#include "volumes/occupancy_queries.hpp"
#include "volumes/occupancy_update.hpp"

GGSLAM_DECLARE_KERNEL(void depth_row_to_world(const float* depth, int width, float fx, float cx, float y,
                                              const float T[12], float low, float high, float* points))

namespace ggslam {
namespace {

struct OccupancyMap {
  OccupancyTree tree;
  Scan scan;
  Buffer<float> points;
  std::vector<std::uint8_t> output;  // of the last call that made some
  explicit OccupancyMap(double resolution) : tree(resolution) {}
};

OccupancyMap& map_of(void* handle) { return object_of<OccupancyMap>(handle); }

// How many voxels a scan saw free that it did not see occupied.
std::size_t free_voxels(const Scan& scan) {
  std::size_t n = 0;
  for (std::size_t b = 0; b < scan.free().blocks(); ++b) {
    const std::uint64_t* occupied = scan.occupied().find(scan.free().code(b));
    for (int w = 0; w < kMaskWords; ++w)
      n += __builtin_popcountll(scan.free().words(b)[w] & ~(occupied ? occupied[w] : 0));
  }
  return n;
}

bool insert(Context& context, OccupancyMap& map, const float* points, std::size_t n, const InsertSettings& s,
            InsertResult& result, const std::vector<float>& empty = {}) {
  const ScanSettings settings{{s.origin[0], s.origin[1], s.origin[2]}, s.max_range, s.quantize != 0, s.last_voxel != 0,
                              s.most_hits > 1};
  if (!map.scan.cast(context, map.tree.grid, settings, points, n, empty)) return false;
  apply_scan(context, map.scan, {s.hit, s.miss, s.minimum, s.maximum, s.most_hits}, map.tree);
  result = {map.scan.rays(), free_voxels(map.scan), map.scan.occupied().voxels()};
  return true;
}

// World points at depth `free` of the pixels that found nothing, [n, 3].
std::vector<float> empty_points(const DepthImage& in) {
  std::vector<float> points;
  if (!(in.free > 0)) return points;
  const float* T = in.T_world_camera;
  for (int v = 0; v < in.height; ++v)
    for (int u = 0; u < in.width; ++u) {
      if (in.depth[static_cast<std::size_t>(v) * in.width + u] != std::numeric_limits<float>::infinity()) continue;
      const float z = in.free, x = (u - in.cx) / in.fx * z, y = (v - in.cy) / in.fy * z;
      for (int a = 0; a < 3; ++a) points.push_back(T[4 * a] * x + T[4 * a + 1] * y + T[4 * a + 2] * z + T[4 * a + 3]);
    }
  return points;
}

void check_scan(const float* points, std::uint64_t n, const InsertSettings* pointer, const InsertResult* result) {
  check_array("points", points, static_cast<std::int64_t>(elements(static_cast<std::int64_t>(n), 3)));
  const InsertSettings& s = object_of<InsertSettings>(pointer);
  object_of<InsertResult>(result);
  if (std::isnan(s.max_range)) refuse("max_range: expected a number");
  const float log_odds[] = {s.hit, s.miss, s.minimum, s.maximum};
  check_within("log-odds", log_odds, 4, 1e6);
}

void check_resolution(double resolution) { check_range("resolution", resolution, 1e-6, 1e6); }

void put_keys(std::uint16_t*& out, std::uint64_t code) {
  cast<std::uint16_t>(keys_of_morton(code)).to(out);
  out += 3;
}

}  // namespace
}  // namespace ggslam

using namespace ggslam;

GGSLAM_EXPORT void* ggslam_occupancy_create(double resolution) try {
  check_resolution(resolution);
  return new OccupancyMap(resolution);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_occupancy_destroy(void* map) try {
  delete static_cast<OccupancyMap*>(map);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_occupancy_insert(void* context, void* map, const float* points, std::uint64_t n,
                                          const InsertSettings* settings, InsertResult* result) try {
  check_scan(points, n, settings, result);
  return insert(object_of<Context>(context), map_of(map), points, n, *settings, *result) ? 1 : 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_occupancy_insert_depth(void* context_, void* map_, const DepthImage* image,
                                                const InsertSettings* settings, InsertResult* result) try {
  Context& context = object_of<Context>(context_);
  OccupancyMap& map = map_of(map_);
  const DepthImage& in = object_of<DepthImage>(image);
  check_scan(in.depth, 1, settings, result);
  check_camera(in.width, in.height, in.fx, in.fy, in.cx, in.cy);
  const std::size_t width = image->width, pixels = width * image->height;
  map.points.reserve(3 * pixels);
  const auto kernel = GGSLAM_DISPATCH(context.isa, depth_row_to_world);
  context.pool.parallel_for(image->height, 16, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t v = begin; v < end; ++v)
      kernel(image->depth + v * width, image->width, image->fx, image->cx, (v - image->cy) / image->fy,
             image->T_world_camera, image->low, image->high, map.points.data() + 3 * v * width);
  });
  return insert(context, map, map.points.data(), pixels, *settings, *result, empty_points(in)) ? 1 : 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_occupancy_look_up(void* context, void* map, const float* points, std::uint64_t n,
                                           float threshold, std::int8_t* states, float* log_odds) try {
  check_array("points", points, static_cast<std::int64_t>(elements(static_cast<std::int64_t>(n), 3)));
  look_up(object_of<Context>(context), map_of(map).tree, points, n, threshold, states, log_odds);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_occupancy_summary(void* map, float threshold, OccupancySummary* summary) try {
  object_of<OccupancySummary>(summary) = summarize(map_of(map).tree, threshold);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_occupancy_compare(void* one, void* other, float threshold_one, float threshold_other,
                                           std::uint64_t counts[9]) try {
  check_array("counts", counts, 9);
  count_states(map_of(one).tree, map_of(other).tree, threshold_one, threshold_other, counts);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT const void* ggslam_occupancy_output(void* map) try {
  return map_of(map).output.data();
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::uint64_t ggslam_occupancy_leaves(void* map_, float threshold, int which) try {
  OccupancyMap& map = map_of(map_);
  const std::vector<OccupancyLeaf> leaves = list_leaves(map.tree, threshold, which);
  const auto* bytes = reinterpret_cast<const std::uint8_t*>(leaves.data());
  map.output.assign(bytes, bytes + leaves.size() * sizeof(OccupancyLeaf));
  return map.output.size();
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::uint64_t ggslam_occupancy_write(void* map_, int format, float threshold, std::uint64_t* nodes) try {
  OccupancyMap& map = map_of(map_);
  check_range("format", format, 0, 1), check_array("nodes", nodes, 1);
  OctomapText text = write_octomap(map.tree, static_cast<OctomapFormat>(format), threshold);
  map.output.swap(text.data);
  *nodes = text.nodes;
  return map.output.size();
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_occupancy_read(void* map, int format, const std::uint8_t* data, std::uint64_t size, float free,
                                        float occupied, std::uint64_t maximum_blocks, std::uint64_t* nodes) try {
  check_range("format", format, 0, 1), check_array("nodes", nodes, 1);
  check_array("data", data, static_cast<std::int64_t>(elements(static_cast<std::int64_t>(size))));
  const OctomapReading reading =
      read_octomap(map_of(map).tree, static_cast<OctomapFormat>(format), data, size, free, occupied, maximum_blocks);
  *nodes = reading.nodes;
  return static_cast<int>(reading.fault);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_occupancy_scan_keys(void* context, void* map_, const float* points, std::uint64_t n,
                                                      const InsertSettings* s, InsertResult* result) try {
  OccupancyMap& map = map_of(map_);
  check_scan(points, n, s, result);
  ScanSettings settings{{s->origin[0], s->origin[1], s->origin[2]}, s->max_range, s->quantize != 0,
                        s->last_voxel != 0};
  if (!map.scan.cast(object_of<Context>(context), map.tree.grid, settings, points, n)) return -1;
  *result = {map.scan.rays(), free_voxels(map.scan), map.scan.occupied().voxels()};
  map.output.resize((result->free + result->occupied) * 3 * sizeof(std::uint16_t));
  auto* out = reinterpret_cast<std::uint16_t*>(map.output.data());
  std::uint64_t last = ~std::uint64_t{0};
  const std::uint64_t* hits = nullptr;
  for_each_voxel(map.scan.free(), [&](std::uint64_t code) {
    if (code >> 9 != last) hits = map.scan.occupied().find(last = code >> 9);
    if (hits == nullptr || !(hits[(code >> 6) & 7] >> (code & 63) & 1)) put_keys(out, code);
  });
  for_each_voxel(map.scan.occupied(), [&](std::uint64_t code) { put_keys(out, code); });
  return static_cast<std::int64_t>(map.output.size());
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::uint64_t ggslam_quantize(void* context, double resolution, const float* points, std::uint64_t n,
                                            std::uint16_t* keys, std::int32_t* counts) try {
  check_resolution(resolution);
  check_array("points", points, static_cast<std::int64_t>(elements(static_cast<std::int64_t>(n), 3)));
  check_array("keys", keys, static_cast<std::int64_t>(n));
  std::vector<std::int64_t> codes;
  VoxelMasks voxels;
  quantize(object_of<Context>(context), KeyGrid(resolution), points, n, codes, voxels);
  std::uint16_t* out = keys;
  for_each_voxel(voxels, [&](std::uint64_t code) { put_keys(out, code); });
  if (counts != nullptr) {
    PointCounts found;
    found.take(codes, voxels);
    std::copy(found.counts.begin(), found.counts.end(), counts);
  }
  return static_cast<std::uint64_t>(out - keys) / 3;
} GGSLAM_CATCH_ALL
