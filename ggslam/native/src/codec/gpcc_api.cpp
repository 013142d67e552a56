// SPDX-License-Identifier: Apache-2.0
// Entry points of the G-PCC codec. A slice object holds the octree that geometry and attributes share, and the bytes
// that were coded last. Functions return a status, or where they say so a size (negative: minus the status).
#include "codec/gpcc.hpp"

#include <algorithm>
#include <map>
#include <new>

#include "common/context.hpp"

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

template <class Function>
std::int64_t guarded(const Function& function) {
  try {
    return function();
  } catch (const std::bad_alloc&) {
    return -static_cast<std::int64_t>(kOutOfMemory);
  }
}

Isa isa_of(void* context) { return static_cast<Context*>(context)->isa; }

}  // namespace
}  // namespace gpcc
}  // namespace ggslam

using namespace ggslam;
using gpcc::Slice;

GGSLAM_EXPORT void* ggslam_gpcc_slice_create() { return new (std::nothrow) Slice; }

GGSLAM_EXPORT void ggslam_gpcc_slice_destroy(void* slice) { delete static_cast<Slice*>(slice); }

GGSLAM_EXPORT std::int64_t ggslam_gpcc_build(void* context, void* slice, const std::int32_t* points, std::uint32_t count,
                                             std::int32_t depth, std::uint32_t* order) {
  return gpcc::guarded([&]() -> std::int64_t {
    std::vector<std::uint64_t> codes(count);
    GGSLAM_DISPATCH(gpcc::isa_of(context), morton_order)(points, count, depth, order, codes.data());
    GGSLAM_DISPATCH(gpcc::isa_of(context), octree_build)(codes.data(), count, depth, static_cast<Slice*>(slice)->tree);
    return gpcc::kOk;
  });
}

GGSLAM_EXPORT std::uint32_t ggslam_gpcc_leaves(void* slice) { return static_cast<Slice*>(slice)->tree.leaves; }

GGSLAM_EXPORT std::uint32_t ggslam_gpcc_nodes(void* slice, std::int32_t level) {
  return static_cast<Slice*>(slice)->tree.levels[level].size();
}

GGSLAM_EXPORT void ggslam_gpcc_leaf_points(void* slice, std::uint32_t* counts) {
  const gpcc::Octree& tree = static_cast<Slice*>(slice)->tree;
  for (std::uint32_t leaf = 1; leaf <= tree.leaves; ++leaf) counts[leaf - 1] = tree.weight_of_leaf(leaf);
}

GGSLAM_EXPORT std::int64_t ggslam_gpcc_merge(void* slice) {
  return gpcc::guarded([&]() -> std::int64_t {
    gpcc::Octree& tree = static_cast<Slice*>(slice)->tree;
    tree.leaf_points.clear();
    tree.points = tree.leaves;
    gpcc::sum_weights(tree);
    return gpcc::kOk;
  });
}

GGSLAM_EXPORT std::int64_t ggslam_gpcc_encode_geometry(void* context, void* slice, const gpcc::OctreeSettings* settings) {
  return gpcc::guarded([&]() -> std::int64_t {
    Slice& s = *static_cast<Slice*>(slice);
    s.bytes.clear();
    GGSLAM_DISPATCH(gpcc::isa_of(context), octree_encode)(*settings, s.tree, s.bytes);
    return static_cast<std::int64_t>(s.bytes.size());
  });
}

GGSLAM_EXPORT std::int64_t ggslam_gpcc_encode_attribute(void* context, void* slice, const gpcc::RahtSettings* settings,
                                                        std::int32_t* attributes) {
  return gpcc::guarded([&]() -> std::int64_t {
    Slice& s = *static_cast<Slice*>(slice);
    s.bytes.clear();
    const gpcc::Status status =
        GGSLAM_DISPATCH(gpcc::isa_of(context), raht_encode)(*settings, s.tree, attributes, s.bytes);
    return status == gpcc::kOk ? static_cast<std::int64_t>(s.bytes.size()) : -static_cast<std::int64_t>(status);
  });
}

GGSLAM_EXPORT void ggslam_gpcc_take(void* slice, std::uint8_t* out) {
  std::vector<std::uint8_t>& bytes = static_cast<Slice*>(slice)->bytes;
  std::copy(bytes.begin(), bytes.end(), out);
  bytes.clear();
}

GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_geometry(void* context, void* slice, const gpcc::OctreeSettings* settings,
                                                       const std::uint8_t* data, std::size_t size,
                                                       std::uint32_t points) {
  return gpcc::guarded([&]() -> std::int64_t {
    Slice& s = *static_cast<Slice*>(slice);
    const gpcc::Status status =
        GGSLAM_DISPATCH(gpcc::isa_of(context), octree_decode)(*settings, data, size, points, s.tree);
    if (status == gpcc::kOk) gpcc::sum_weights(s.tree);
    s.stream_order.clear();
    return -static_cast<std::int64_t>(status);
  });
}

GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_tree(void* context, void* slice, const gpcc::TreeSettings* settings,
                                                   std::int32_t depth, const std::uint8_t* data, std::size_t size,
                                                   std::uint32_t points) {
  return gpcc::guarded([&]() -> std::int64_t {
    Slice& s = *static_cast<Slice*>(slice);
    std::vector<std::int32_t> positions;
    const gpcc::Status status = GGSLAM_DISPATCH(gpcc::isa_of(context), tree_decode)(
        *settings, data, size, points, s.geometry_contexts, positions);
    if (status == gpcc::kOk) gpcc::build_octree(gpcc::isa_of(context), positions, depth, s);
    return -static_cast<std::int64_t>(status);
  });
}

GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_predictive(void* context, void* slice,
                                                         const gpcc::PredictiveSettings* settings, std::int32_t depth,
                                                         const std::uint8_t* data, std::size_t size,
                                                         std::uint32_t points) {
  return gpcc::guarded([&]() -> std::int64_t {
    Slice& s = *static_cast<Slice*>(slice);
    std::vector<std::int32_t> positions;
    const gpcc::Status status = GGSLAM_DISPATCH(gpcc::isa_of(context), predictive_decode)(
        *settings, data, size, points, s.geometry_contexts, positions);
    if (status == gpcc::kOk) gpcc::build_octree(gpcc::isa_of(context), positions, depth, s);
    return -static_cast<std::int64_t>(status);
  });
}

GGSLAM_EXPORT std::int64_t ggslam_gpcc_encode_tree(void* context, void* slice, const gpcc::TreeSettings* settings) {
  return gpcc::guarded([&]() -> std::int64_t {
    Slice& s = *static_cast<Slice*>(slice);
    std::vector<std::int32_t> positions(3 * s.tree.points);
    std::vector<std::uint64_t> keys;
    GGSLAM_DISPATCH(gpcc::isa_of(context), octree_positions)(s.tree, positions.data());
    GGSLAM_DISPATCH(gpcc::isa_of(context), tree_keys)(positions.data(), s.tree.points, *settings, keys);
    s.bytes.clear();
    GGSLAM_DISPATCH(gpcc::isa_of(context), tree_encode)(
        *settings, keys.data(), static_cast<std::uint32_t>(keys.size()), s.bytes);
    return static_cast<std::int64_t>(s.bytes.size());
  });
}

GGSLAM_EXPORT std::int64_t ggslam_gpcc_go_on(void* slice, const void* before) {
  return gpcc::guarded([&]() -> std::int64_t {
    const Slice& b = *static_cast<const Slice*>(before);
    static_cast<Slice*>(slice)->geometry_contexts = b.geometry_contexts;
    static_cast<Slice*>(slice)->attribute_contexts = b.attribute_contexts;
    return gpcc::kOk;
  });
}

GGSLAM_EXPORT std::int64_t ggslam_gpcc_positions(void* context, void* slice, std::int32_t* out) {
  return gpcc::guarded([&]() -> std::int64_t {
    GGSLAM_DISPATCH(gpcc::isa_of(context), octree_positions)(static_cast<Slice*>(slice)->tree, out);
    return gpcc::kOk;
  });
}

GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_attribute(void* context, void* slice, const gpcc::RahtSettings* settings,
                                                        const std::uint8_t* data, std::size_t size,
                                                        std::int32_t* attributes) {
  return gpcc::guarded([&]() -> std::int64_t {
    Slice& s = *static_cast<Slice*>(slice);
    return -static_cast<std::int64_t>(GGSLAM_DISPATCH(gpcc::isa_of(context), raht_decode)(
        *settings, s.tree, data, size, s.attribute_contexts[settings->index], attributes));
  });
}

GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_details(void* context, void* slice, const gpcc::DetailSettings* settings,
                                                      const std::uint8_t* data, std::size_t size,
                                                      std::int32_t* attributes) {
  return gpcc::guarded([&]() -> std::int64_t {
    Slice& s = *static_cast<Slice*>(slice);
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
  });
}

GGSLAM_EXPORT std::int64_t ggslam_gpcc_sort_values(void* slice, std::int32_t components, std::int32_t* values) {
  return gpcc::guarded([&]() -> std::int64_t {
    gpcc::from_stream_order(static_cast<Slice*>(slice)->stream_order, components, values);
    return gpcc::kOk;
  });
}

GGSLAM_EXPORT void ggslam_gpcc_to_ycbcr(void* context, const std::uint8_t* rgb, const std::uint32_t* order,
                                        std::uint32_t count, std::int32_t* out) {
  GGSLAM_DISPATCH(gpcc::isa_of(context), colours_to_ycbcr)(rgb, order, count, out);
}

GGSLAM_EXPORT void ggslam_gpcc_from_ycbcr(void* context, const std::int32_t* components, std::uint32_t count,
                                          std::uint8_t* rgb) {
  GGSLAM_DISPATCH(gpcc::isa_of(context), colours_from_ycbcr)(components, count, rgb);
}
