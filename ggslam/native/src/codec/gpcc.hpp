// SPDX-License-Identifier: Apache-2.0
// What the entry points and the kernels of the G-PCC codec (ISO/IEC 23090-9, first edition) share.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

#include "common/dispatch.hpp"
#include "abi/core/codec.hpp"

namespace ggslam::gpcc {

// A decoder holds no more than this; slices within the level limit of 1.1 million points need less.
inline constexpr std::uint64_t kMaxNodes = 24u << 20;  // of all levels together
inline constexpr std::int64_t kMaxPosition = 1 << 21;  // in a slice
inline constexpr std::uint32_t kMaxLinked = 2u << 20;  // nodes of one level that have neighbours

// The nodes of one size in Morton order. Entry 0 of each array stands for "no node"; nodes count from 1.
struct Level {
  std::vector<std::uint8_t> occupancy;
  std::vector<std::uint32_t> first_child;  // index of the first child in the next level (or of the first leaf)
  std::vector<std::uint32_t> weight;       // points below

  std::uint32_t size() const { return static_cast<std::uint32_t>(occupancy.size()) - 1; }
};

// levels[0] is the root, levels[depth - 1] holds the parents of the leaves.
struct Octree {
  std::vector<Level> levels;
  std::vector<std::uint32_t> leaf_points;  // from entry 1; empty if every leaf is one point
  std::uint32_t leaves = 0;
  std::uint64_t points = 0;

  int depth() const { return static_cast<int>(levels.size()); }
  std::uint32_t weight_of_leaf(std::uint32_t leaf) const { return leaf_points.empty() ? 1 : leaf_points[leaf]; }
};

// Adaptive contexts that a slice leaves to the next one, as bytes; empty: none.
struct Memory {
  std::vector<std::uint8_t> bytes;

  template <class Contexts>
  void load(Contexts& contexts) const {
    if (bytes.size() == sizeof(Contexts)) std::memcpy(static_cast<void*>(&contexts), bytes.data(), sizeof(Contexts));
  }
  template <class Contexts>
  void save(const Contexts& contexts) {
    const auto* begin = reinterpret_cast<const std::uint8_t*>(&contexts);
    bytes.assign(begin, begin + sizeof(Contexts));
  }
};

// Counts the points below every node; needed by the attribute coder.
void sum_weights(Octree& tree);

}  // namespace ggslam::gpcc
