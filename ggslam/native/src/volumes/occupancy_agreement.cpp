// SPDX-License-Identifier: Apache-2.0
#include "volumes/occupancy_queries.hpp"

namespace ggslam {
namespace {

class Comparison {
 public:
  Comparison(const OccupancyTree& one, const OccupancyTree& other, float threshold_one, float threshold_other,
             std::uint64_t counts[9])
      : sides_{{one, threshold_one}, {other, threshold_other}}, counts_(counts) {}

  // The same part of space in both maps; a cell that is the same throughout stands for its children as well.
  void visit(const Cell& one, const Cell& other, int depth) {
    if (one.kind == CellKind::node || other.kind == CellKind::node) {
      for (int i = 0; i < 8; ++i) visit(child(sides_[0], one, i), child(sides_[1], other, i), depth + 1);
    } else if (one.kind == CellKind::block || other.kind == CellKind::block) {
      for (int voxel = 0; voxel < kBlockVoxels; ++voxel)
        ++counts_[3 * state(sides_[0], one, voxel) + state(sides_[1], other, voxel)];
    } else {
      counts_[3 * state(sides_[0], one, 0) + state(sides_[1], other, 0)] += std::uint64_t{1}
                                                                            << (3 * (kKeyBits - depth));
    }
  }

 private:
  struct Side {
    const OccupancyTree& tree;
    float threshold;
  };

  static const Cell& child(const Side& side, const Cell& cell, int i) {
    return cell.kind == CellKind::node ? side.tree.nodes[cell.index].child[i] : cell;
  }

  // 0 unknown, 1 free, 2 occupied.
  static int state(const Side& side, const Cell& cell, int voxel) {
    if (cell.kind == CellKind::unknown) return 0;
    if (cell.kind == CellKind::leaf) return cell.value >= side.threshold ? 2 : 1;
    const OccupancyBlock& block = side.tree.blocks[cell.index];
    if ((block.known[voxel / 64] >> (voxel % 64) & 1) == 0) return 0;
    return block.value[voxel] >= side.threshold ? 2 : 1;
  }

  Side sides_[2];
  std::uint64_t* counts_;
};

}  // namespace

void count_states(const OccupancyTree& one, const OccupancyTree& other, float threshold_one, float threshold_other,
                  std::uint64_t counts[9]) {
  for (int i = 0; i < 9; ++i) counts[i] = 0;
  Comparison(one, other, threshold_one, threshold_other, counts).visit(one.root, other.root, 0);
}

}  // namespace ggslam
