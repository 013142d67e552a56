// SPDX-License-Identifier: Apache-2.0
// Entry points of the G-PCC codec. A slice object holds the octree that geometry and attributes share, and the bytes
// that were coded last. Functions return a status, or where they say so a size (negative: minus the status).
#include "codec/gpcc.hpp"

#include <algorithm>
#include <map>
#include <new>

#include "common/context.hpp"
#include "common/guard.hpp"

GGSLAM_DECLARE_KERNEL(void morton_order(const std::int32_t* points, std::uint32_t count, int depth,
                                        std::uint32_t* order, std::uint64_t* codes))
GGSLAM_DECLARE_KERNEL(void octree_build(const std::uint64_t* codes, std::uint32_t count, int depth, gpcc::Octree& tree))
GGSLAM_DECLARE_KERNEL(void octree_positions(const gpcc::Octree& tree, std::int32_t* out))
GGSLAM_DECLARE_KERNEL(void octree_encode(const gpcc::OctreeSettings& settings, gpcc::Octree& tree,
                                         std::vector<std::uint8_t>& out))
GGSLAM_DECLARE_KERNEL(gpcc::Status octree_decode(const gpcc::OctreeSettings& settings, const std::uint8_t* data,
                                                 std::size_t size, std::uint64_t points, gpcc::Octree& tree))
GGSLAM_DECLARE_KERNEL(void tree_keys(const std::int32_t* points, std::size_t count, const gpcc::TreeSettings& settings,
                                     std::vector<std::uint64_t>& keys))
GGSLAM_DECLARE_KERNEL(void tree_encode(const gpcc::TreeSettings& settings, const std::uint64_t* keys,
                                       std::uint32_t count, std::vector<std::uint8_t>& out))
GGSLAM_DECLARE_KERNEL(gpcc::Status tree_decode(const gpcc::TreeSettings& settings, const std::uint8_t* data,
                                               std::size_t size, std::uint64_t points, gpcc::Memory& memory,
                                               std::vector<std::int32_t>& out))
GGSLAM_DECLARE_KERNEL(gpcc::Status predictive_decode(const gpcc::PredictiveSettings& settings, const std::uint8_t* data,
                                                     std::size_t size, std::uint32_t points, gpcc::Memory& memory,
                                                     std::vector<std::int32_t>& out))
GGSLAM_DECLARE_KERNEL(gpcc::Status raht_encode(const gpcc::RahtSettings& settings, const gpcc::Octree& tree,
                                               std::int32_t* attributes, std::vector<std::uint8_t>& out))
GGSLAM_DECLARE_KERNEL(gpcc::Status raht_decode(const gpcc::RahtSettings& settings, const gpcc::Octree& tree,
                                               const std::uint8_t* data, std::size_t size, gpcc::Memory& memory,
                                               std::int32_t* attributes))
GGSLAM_DECLARE_KERNEL(gpcc::Status detail_decode(const gpcc::DetailSettings& settings, const std::int32_t* points,
                                                 const std::uint64_t* codes, std::uint32_t count,
                                                 const std::uint8_t* data, std::size_t size, gpcc::Memory& memory,
                                                 std::int32_t* values))
GGSLAM_DECLARE_KERNEL(void colours_to_ycbcr(const std::uint8_t* rgb, const std::uint32_t* order, std::uint32_t count,
                                            std::int32_t* out))
GGSLAM_DECLARE_KERNEL(void colours_from_ycbcr(const std::int32_t* components, std::uint32_t count, std::uint8_t* rgb))

namespace ggslam {
namespace gpcc {

void sum_weights(Octree& tree) {
  for (int depth = tree.depth() - 1; depth >= 0; --depth) {
    Level& level = tree.levels[depth];
    const bool leaves_below = depth + 1 == tree.depth();
    level.weight.assign(level.size() + std::size_t{1}, 0);
    for (std::uint32_t node = 1; node <= level.size(); ++node) {
      const std::uint32_t first = level.first_child[node], count = __builtin_popcount(level.occupancy[node]);
      std::uint32_t sum = 0;
      for (std::uint32_t child = first; child < first + count; ++child)
        sum += leaves_below ? tree.weight_of_leaf(child) : tree.levels[depth + 1].weight[child];
      level.weight[node] = sum;
    }
  }
}

namespace {

struct Slice {
  Octree tree;
  std::vector<std::uint8_t> bytes;
  std::vector<std::uint32_t> stream_order;  // where each point of the coding order stands in the stream; empty: there
  Memory geometry_contexts;
  std::map<std::int32_t, Memory> attribute_contexts;
};

// Makes the octree of positions [*, 3] in [0, 2^depth).
void build_octree(Isa isa, const std::vector<std::int32_t>& positions, int depth, Slice& slice) {
  const auto count = static_cast<std::uint32_t>(positions.size() / 3);
  std::vector<std::uint64_t> codes(count);
  slice.stream_order.resize(count);
  GGSLAM_DISPATCH(isa, morton_order)(positions.data(), count, depth, slice.stream_order.data(), codes.data());
  GGSLAM_DISPATCH(isa, octree_build)(codes.data(), count, depth, slice.tree);
}

void from_stream_order(const std::vector<std::uint32_t>& order, int components, std::int32_t* values) {
  const std::vector<std::int32_t> stream(values, values + order.size() * components);
  for (std::size_t i = 0; i < order.size(); ++i)
    for (int k = 0; k < components; ++k) values[i * components + k] = stream[std::size_t{order[i]} * components + k];
}

void to_stream_order(const std::vector<std::uint32_t>& order, int components, std::int32_t* values) {
  const std::vector<std::int32_t> coding(values, values + order.size() * components);
  for (std::size_t i = 0; i < order.size(); ++i)
    for (int k = 0; k < components; ++k) values[std::size_t{order[i]} * components + k] = coding[i * components + k];
}

void check_depth(int depth) { check_range("depth", depth, 0, 21); }

void check_positions(const std::int32_t* points, std::size_t count, int depth) {
  std::uint32_t all = 0;  // a coordinate that is negative or too large has a bit that none may have
  for (std::size_t i = 0; i < 3 * count; ++i) all |= static_cast<std::uint32_t>(points[i]);
  if (all >> depth != 0) refuse("points: expected coordinates of 0 to below 2^%d", depth);
}

void check_payload(const std::uint8_t* data, std::size_t size) {
  check_array("data", data, static_cast<std::int64_t>(elements(static_cast<std::int64_t>(size))));
}

// Values of an attribute of the slice's points.
template <class Settings>
const Settings& check_attribute(const Slice& slice, const Settings* pointer, const std::int32_t* values) {
  const Settings& settings = object_of<Settings>(pointer);
  check_range("components", settings.components, 1, 3);
  if (slice.tree.levels.empty() && slice.tree.leaves == 0) refuse("slice: it has no octree yet");
  check_array("attributes", values, static_cast<std::int64_t>(slice.tree.points));
  return settings;
}

Isa isa_of(void* context) { return object_of<Context>(context).isa; }

}  // namespace
}  // namespace gpcc
}  // namespace ggslam

using namespace ggslam;
using gpcc::Slice;

GGSLAM_EXPORT void* ggslam_gpcc_slice_create() try {
  return new (std::nothrow) Slice;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gpcc_slice_destroy(void* slice) try {
  delete static_cast<Slice*>(slice);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_build(void* context, void* slice, const std::int32_t* points, std::uint32_t count,
                                             std::int32_t depth, std::uint32_t* order) try {
  check_array("points", points, count), check_array("order", order, count);
  gpcc::check_depth(depth);
  gpcc::check_positions(points, count, depth);
  std::vector<std::uint64_t> codes(count);
  GGSLAM_DISPATCH(gpcc::isa_of(context), morton_order)(points, count, depth, order, codes.data());
  GGSLAM_DISPATCH(gpcc::isa_of(context), octree_build)(codes.data(), count, depth, object_of<Slice>(slice).tree);
  return gpcc::kOk;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::uint32_t ggslam_gpcc_leaves(void* slice) try {
  return object_of<Slice>(slice).tree.leaves;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::uint32_t ggslam_gpcc_nodes(void* slice, std::int32_t level) try {
  const std::vector<gpcc::Level>& levels = object_of<Slice>(slice).tree.levels;
  check_range<std::int64_t>("level", level, 0, static_cast<std::int64_t>(levels.size()) - 1);
  return levels[level].size();
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gpcc_leaf_points(void* slice, std::uint32_t* counts) try {
  const gpcc::Octree& tree = object_of<Slice>(slice).tree;
  check_array("counts", counts, tree.leaves);
  for (std::uint32_t leaf = 1; leaf <= tree.leaves; ++leaf) counts[leaf - 1] = tree.weight_of_leaf(leaf);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_merge(void* slice) try {
  gpcc::Octree& tree = object_of<Slice>(slice).tree;
  tree.leaf_points.clear();
  tree.points = tree.leaves;
  gpcc::sum_weights(tree);
  return gpcc::kOk;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_encode_geometry(void* context, void* slice, const gpcc::OctreeSettings* settings) try {
  Slice& s = object_of<Slice>(slice);
  const int depth = object_of<gpcc::OctreeSettings>(settings).depth;
  if (depth != s.tree.depth()) refuse("depth: expected that of the octree, %d, found %d", s.tree.depth(), depth);
  s.bytes.clear();
  GGSLAM_DISPATCH(gpcc::isa_of(context), octree_encode)(
      object_of<gpcc::OctreeSettings>(settings), s.tree, s.bytes);
  return static_cast<std::int64_t>(s.bytes.size());
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_encode_attribute(void* context, void* slice, const gpcc::RahtSettings* settings,
                                                        std::int32_t* attributes) try {
  Slice& s = object_of<Slice>(slice);
  if (s.tree.levels.empty()) refuse("slice: it has no octree yet");
  s.bytes.clear();
  const gpcc::Status status =
      GGSLAM_DISPATCH(gpcc::isa_of(context), raht_encode)(
          gpcc::check_attribute(s, settings, attributes), s.tree, attributes, s.bytes);
  return status == gpcc::kOk ? static_cast<std::int64_t>(s.bytes.size()) : -static_cast<std::int64_t>(status);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gpcc_take(void* slice, std::uint8_t* out) try {
  std::vector<std::uint8_t>& bytes = object_of<Slice>(slice).bytes;
  check_array("out", out, static_cast<std::int64_t>(bytes.size()));
  std::copy(bytes.begin(), bytes.end(), out);
  bytes.clear();
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_geometry(void* context, void* slice, const gpcc::OctreeSettings* settings,
                                                       const std::uint8_t* data, std::size_t size,
                                                       std::uint32_t points) try {
  Slice& s = object_of<Slice>(slice);
  gpcc::check_payload(data, size);
  gpcc::check_depth(object_of<gpcc::OctreeSettings>(settings).depth);
  const gpcc::Status status =
      GGSLAM_DISPATCH(gpcc::isa_of(context), octree_decode)(*settings, data, size, points, s.tree);
  if (status == gpcc::kOk) gpcc::sum_weights(s.tree);
  s.stream_order.clear();
  return -static_cast<std::int64_t>(status);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_tree(void* context, void* slice, const gpcc::TreeSettings* settings,
                                                   std::int32_t depth, const std::uint8_t* data, std::size_t size,
                                                   std::uint32_t points) try {
  Slice& s = object_of<Slice>(slice);
  gpcc::check_payload(data, size);
  gpcc::check_depth(depth);
  check_range("levels", object_of<gpcc::TreeSettings>(settings).levels, 0, 64);
  std::vector<std::int32_t> positions;
  const gpcc::Status status = GGSLAM_DISPATCH(gpcc::isa_of(context), tree_decode)(
      *settings, data, size, points, s.geometry_contexts, positions);
  if (status == gpcc::kOk) gpcc::build_octree(gpcc::isa_of(context), positions, depth, s);
  return -static_cast<std::int64_t>(status);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_predictive(void* context, void* slice,
                                                         const gpcc::PredictiveSettings* settings, std::int32_t depth,
                                                         const std::uint8_t* data, std::size_t size,
                                                         std::uint32_t points) try {
  Slice& s = object_of<Slice>(slice);
  gpcc::check_payload(data, size);
  gpcc::check_depth(depth);
  std::vector<std::int32_t> positions;
  const gpcc::Status status = GGSLAM_DISPATCH(gpcc::isa_of(context), predictive_decode)(
      object_of<gpcc::PredictiveSettings>(settings), data, size, points, s.geometry_contexts, positions);
  if (status == gpcc::kOk) gpcc::build_octree(gpcc::isa_of(context), positions, depth, s);
  return -static_cast<std::int64_t>(status);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_encode_tree(void* context, void* slice, const gpcc::TreeSettings* settings) try {
  Slice& s = object_of<Slice>(slice);
  check_range("levels", object_of<gpcc::TreeSettings>(settings).levels, 0, 64);
  std::vector<std::int32_t> positions(3 * s.tree.points);
  std::vector<std::uint64_t> keys;
  GGSLAM_DISPATCH(gpcc::isa_of(context), octree_positions)(s.tree, positions.data());
  GGSLAM_DISPATCH(gpcc::isa_of(context), tree_keys)(positions.data(), s.tree.points, *settings, keys);
  s.bytes.clear();
  GGSLAM_DISPATCH(gpcc::isa_of(context), tree_encode)(
      *settings, keys.data(), static_cast<std::uint32_t>(keys.size()), s.bytes);
  return static_cast<std::int64_t>(s.bytes.size());
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_go_on(void* slice, const void* before) try {
  const Slice& b = object_of<Slice>(before);
  object_of<Slice>(slice).geometry_contexts = b.geometry_contexts;
  object_of<Slice>(slice).attribute_contexts = b.attribute_contexts;
  return gpcc::kOk;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_positions(void* context, void* slice, std::int32_t* out) try {
  const Slice& s = object_of<Slice>(slice);
  check_array("out", out, static_cast<std::int64_t>(s.tree.points));
  GGSLAM_DISPATCH(gpcc::isa_of(context), octree_positions)(s.tree, out);
  return gpcc::kOk;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_attribute(void* context, void* slice, const gpcc::RahtSettings* settings,
                                                        const std::uint8_t* data, std::size_t size,
                                                        std::int32_t* attributes) try {
  Slice& s = object_of<Slice>(slice);
  gpcc::check_payload(data, size);
  gpcc::check_attribute(s, settings, attributes);
  return -static_cast<std::int64_t>(GGSLAM_DISPATCH(gpcc::isa_of(context), raht_decode)(
      *settings, s.tree, data, size, s.attribute_contexts[settings->index], attributes));
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_details(void* context, void* slice, const gpcc::DetailSettings* settings,
                                                      const std::uint8_t* data, std::size_t size,
                                                      std::int32_t* attributes) try {
  Slice& s = object_of<Slice>(slice);
  gpcc::check_payload(data, size);
  gpcc::check_attribute(s, settings, attributes);
  const auto count = static_cast<std::uint32_t>(s.tree.points);
  std::vector<std::int32_t> positions(3 * std::size_t{count});
  GGSLAM_DISPATCH(gpcc::isa_of(context), octree_positions)(s.tree, positions.data());
  const bool canonical = settings->canonical_order != 0 && !s.stream_order.empty();
  if (canonical) gpcc::to_stream_order(s.stream_order, 3, positions.data());
  std::vector<std::uint64_t> codes(count);
  std::vector<std::uint32_t> order(count);
  GGSLAM_DISPATCH(gpcc::isa_of(context), morton_order)(
      positions.data(), count, s.tree.depth(), order.data(), codes.data());
  const gpcc::Status status = GGSLAM_DISPATCH(gpcc::isa_of(context), detail_decode)(
      *settings, positions.data(), codes.data(), count, data, size, s.attribute_contexts[settings->index], attributes);
  if (canonical) gpcc::from_stream_order(s.stream_order, settings->components, attributes);
  return -static_cast<std::int64_t>(status);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT std::int64_t ggslam_gpcc_sort_values(void* slice, std::int32_t components, std::int32_t* values) try {
  const std::vector<std::uint32_t>& order = object_of<Slice>(slice).stream_order;
  check_range("components", components, 1, 1 << 16);
  check_array("values", values, static_cast<std::int64_t>(order.size()));
  gpcc::from_stream_order(order, components, values);
  return gpcc::kOk;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gpcc_to_ycbcr(void* context, const std::uint8_t* rgb, std::uint32_t colors,
                                       const std::uint32_t* order, std::uint32_t count, std::int32_t* out) try {
  check_array("rgb", rgb, colors), check_array("order", order, count), check_array("out", out, count);
  std::uint32_t last = 0;
  for (std::uint32_t i = 0; i < count; ++i) last = std::max(last, order[i]);
  if (count > 0 && last >= colors) refuse("order: expected numbers below %u, found %u", colors, last);
  GGSLAM_DISPATCH(gpcc::isa_of(context), colours_to_ycbcr)(rgb, order, count, out);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gpcc_from_ycbcr(void* context, const std::int32_t* components, std::uint32_t count,
                                         std::uint8_t* rgb) try {
  check_array("components", components, count), check_array("rgb", rgb, count);
  GGSLAM_DISPATCH(gpcc::isa_of(context), colours_from_ycbcr)(components, count, rgb);
  return 0;
} GGSLAM_CATCH_ALL
