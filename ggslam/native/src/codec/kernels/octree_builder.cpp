// SPDX-License-Identifier: Apache-2.0
// From points to octrees and back: Morton codes (x most significant), their sort, and the levels above the leaves.
#include <array>

#include "codec/gpcc.hpp"
#include "codec/kernels/neighbourhood.hpp"

namespace ggslam::GGSLAM_ISA {
namespace codec {
namespace {

using gpcc::Octree;

// The low 21 bits of v, three places apart.
std::uint64_t spread_bits(std::uint64_t v) {
  v &= 0x1fffff;
  v = (v | v << 32) & 0x001f00000000ffffull;
  v = (v | v << 16) & 0x001f0000ff0000ffull;
  v = (v | v << 8) & 0x100f00f00f00f00full;
  v = (v | v << 4) & 0x10c30c30c30c30c3ull;
  return (v | v << 2) & 0x1249249249249249ull;
}

std::uint64_t morton_code(const std::int32_t* p) {
  return spread_bits(p[0]) << 2 | spread_bits(p[1]) << 1 | spread_bits(p[2]);
}

// A code and the place it comes from. Codes of up to 32 bits fit in one word with it.
struct WideKey {
  std::uint64_t code_;
  std::uint32_t index_;
  WideKey() = default;
  WideKey(std::uint64_t code, std::uint32_t index) : code_(code), index_(index) {}
  std::uint64_t code() const { return code_; }
  std::uint32_t index() const { return index_; }
};

struct NarrowKey {
  std::uint64_t word;
  NarrowKey() = default;
  NarrowKey(std::uint64_t code, std::uint32_t index) : word(code << 32 | index) {}
  std::uint64_t code() const { return word >> 32; }
  std::uint32_t index() const { return static_cast<std::uint32_t>(word); }
};

// Least significant digit radix sort, 11 bits at a time; stable.
template <class Key>
void radix_sort(std::vector<Key>& items, int bits) {
  constexpr int kDigit = 11, kBuckets = 1 << kDigit;
  std::vector<Key> other(items.size());
  for (int shift = 0; shift < bits; shift += kDigit) {
    std::array<std::uint32_t, kBuckets> start{};
    for (const Key& item : items) ++start[item.code() >> shift & (kBuckets - 1)];
    std::uint32_t sum = 0;
    for (std::uint32_t& s : start) {
      const std::uint32_t count = s;
      s = sum;
      sum += count;
    }
    for (const Key& item : items) other[start[item.code() >> shift & (kBuckets - 1)]++] = item;
    items.swap(other);
  }
}

template <class Key>
void sort_points(const std::int32_t* points, std::uint32_t count, int depth, std::uint32_t* order, std::uint64_t* codes) {
  std::vector<Key> items(count);
  for (std::uint32_t i = 0; i < count; ++i) items[i] = Key(morton_code(points + 3 * std::size_t{i}), i);
  radix_sort(items, 3 * depth);
  for (std::uint32_t i = 0; i < count; ++i) order[i] = items[i].index(), codes[i] = items[i].code();
}

}  // namespace
}  // namespace codec

// Order of points [count, 3], in [0, 2^depth), by Morton code; points at one place keep their order.
void morton_order(const std::int32_t* points, std::uint32_t count, int depth, std::uint32_t* order,
                  std::uint64_t* codes) {
  if (3 * depth <= 32)
    codec::sort_points<codec::NarrowKey>(points, count, depth, order, codes);
  else
    codec::sort_points<codec::WideKey>(points, count, depth, order, codes);
}

// The octree over sorted Morton codes; equal codes become one leaf of several points.
void octree_build(const std::uint64_t* codes, std::uint32_t count, int depth, gpcc::Octree& tree) {
  tree = gpcc::Octree{};
  tree.levels.resize(depth);
  tree.points = count;
  std::vector<std::uint64_t> here;
  here.reserve(count);
  std::vector<std::uint32_t> points(1, 0);
  for (std::uint32_t i = 0; i < count; ++i) {
    if (i == 0 || codes[i] != here.back()) {
      here.push_back(codes[i]);
      points.push_back(0);
    }
    ++points.back();
  }
  tree.leaves = static_cast<std::uint32_t>(here.size());
  if (tree.leaves < count) tree.leaf_points = std::move(points);
  for (int d = depth - 1; d >= 0; --d) {
    gpcc::Level& level = tree.levels[d];
    level.occupancy.assign(1, 0);
    level.first_child.assign(1, 0);
    std::size_t parents = 0;
    for (std::size_t i = 0; i < here.size(); ++i) {
      const std::uint64_t code = here[i], parent = code >> 3;
      if (parents == 0 || parent != here[parents - 1]) {
        here[parents++] = parent;  // never ahead of i
        level.occupancy.push_back(0);
        level.first_child.push_back(static_cast<std::uint32_t>(i + 1));
      }
      level.occupancy.back() |= static_cast<std::uint8_t>(1u << (code & 7));
    }
    here.resize(parents);
  }
  gpcc::sum_weights(tree);
}

// Positions [points, 3] of a tree's points in Morton order.
void octree_positions(const gpcc::Octree& tree, std::int32_t* out) {
  std::vector<std::uint64_t> codes(2, 0), below;
  for (const gpcc::Level& level : tree.levels) {
    below.assign(1, 0);
    for (std::uint32_t node = 1; node <= level.size(); ++node)
      for (unsigned rest = level.occupancy[node]; rest != 0; rest &= rest - 1)
        below.push_back(codes[node] << 3 | static_cast<unsigned>(__builtin_ctz(rest)));
    codes.swap(below);
  }
  for (std::uint32_t leaf = 1; leaf <= tree.leaves; ++leaf) {
    std::int32_t p[3] = {0, 0, 0};
    for (int bit = 0; bit < tree.depth(); ++bit)
      for (int axis = 0; axis < 3; ++axis)
        p[axis] |= static_cast<std::int32_t>(codes[leaf] >> (3 * bit + 2 - axis) & 1) << bit;
    for (std::uint32_t i = tree.weight_of_leaf(leaf); i > 0; --i, out += 3) out[0] = p[0], out[1] = p[1], out[2] = p[2];
  }
}

}  // namespace ggslam::GGSLAM_ISA
