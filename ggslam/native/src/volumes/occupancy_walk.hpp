// SPDX-License-Identifier: Apache-2.0
// A walk over a map as the octree of 16 levels that it is to OctoMap, pruned: eight children that are equal leaves
// are one leaf. What counts as equal is the sink's to say (the value, or only free or occupied).
#pragma once
#include "volumes/occupancy_tree.hpp"

namespace ggslam {

// What stands at a place of the octree. Of an inner part, `value` is the largest of its leaves.
struct Part {
  CellKind kind = CellKind::unknown;  // unknown, leaf, or node for all others
  float value = 0;
};

// The sink has the functions
//   float value(float)            the value as it is to be compared and stored
//   Mark open()                   before the children of an inner part
//   void leaf(code, depth, value) code: Morton code of its first voxel
//   void close(Mark, const Part child[8], float largest)
//   void revoke(Mark)             what came since open() is one leaf, about to be announced
template <class Sink>
class OccupancyWalk {
 public:
  OccupancyWalk(const OccupancyTree& tree, Sink& sink) : tree_(tree), sink_(sink) {}

  void run() { visit_cell(tree_.root, 0, 0); }

 private:
  template <class VisitChild>
  Part visit_children(std::uint64_t code, int depth, VisitChild visit_child) {
    const auto mark = sink_.open();
    Part child[8];
    for (int i = 0; i < 8; ++i)
      child[i] = visit_child(i, code | static_cast<std::uint64_t>(i) << (3 * (kKeyBits - 1 - depth)));
    Part whole{CellKind::node, -INFINITY};
    bool equal = depth > 0;  // the root stays: a file has no other way to say that all of space is one leaf
    for (const Part& part : child) {
      equal &= part.kind == CellKind::leaf && part.value == child[0].value;
      if (part.kind != CellKind::unknown && part.value > whole.value) whole.value = part.value;
    }
    if (equal) {
      sink_.revoke(mark);
      return leaf(code, depth, child[0].value);
    }
    sink_.close(mark, child, whole.value);
    return whole;
  }

  Part leaf(std::uint64_t code, int depth, float value) {
    sink_.leaf(code, depth, value);
    return {CellKind::leaf, value};
  }

  Part visit_cell(const Cell& cell, std::uint64_t code, int depth) {
    switch (cell.kind) {
      case CellKind::unknown: return {};
      case CellKind::leaf:
        if (depth == 0) return visit_children(code, 0, [&](int, std::uint64_t c) { return visit_cell(cell, c, 1); });
        return leaf(code, depth, sink_.value(cell.value));
      case CellKind::node:
        return visit_children(code, depth, [&](int i, std::uint64_t c) {
          return visit_cell(tree_.nodes[cell.index].child[i], c, depth + 1);
        });
      default: return visit_block(tree_.blocks[cell.index], 0, code, depth);
    }
  }

  // The part of a block that starts at the voxel `first`.
  Part visit_block(const OccupancyBlock& block, int first, std::uint64_t code, int depth) {
    const int voxels = 1 << (3 * (kKeyBits - depth));
    const std::uint64_t known = block.known[first / 64] >> (first % 64);
    if (voxels == 1) return known & 1 ? leaf(code, depth, sink_.value(block.value[first])) : Part{};
    if (voxels == 8 && (known & 0xff) == 0) return {};
    if (voxels == 64 && known == 0) return {};
    return visit_children(code, depth, [&](int i, std::uint64_t c) {
      return visit_block(block, first + i * (voxels / 8), c, depth + 1);
    });
  }

  const OccupancyTree& tree_;
  Sink& sink_;
};

}  // namespace ggslam
