// SPDX-License-Identifier: Apache-2.0
#include "volumes/occupancy_queries.hpp"

#include <algorithm>
#include <limits>

#include "common/box.hpp"
#include "volumes/occupancy_walk.hpp"

namespace ggslam {
namespace {

struct Mark {
  std::size_t leaves;
};

struct LeafSink {
  const KeyGrid& grid;
  float threshold;
  int which;
  std::vector<OccupancyLeaf> leaves;

  float value(float v) const { return v; }
  Mark open() const { return {leaves.size()}; }
  void revoke(const Mark& mark) { leaves.resize(mark.leaves); }
  void close(const Mark&, const Part*, float) {}
  void leaf(std::uint64_t code, int depth, float v) {
    if (which != 0 && (v >= threshold) != (which == 1)) return;
    const double size = grid.resolution * (1 << (kKeyBits - depth));
    OccupancyLeaf out{{}, static_cast<float>(size), v};
    const Vec3d low = grid.resolution * cast<double>(keys_of_morton(code) - Vec3i::all(kKeyOffset));
    cast<float>(low + Vec3d::all(size / 2)).to(out.centre);
    leaves.push_back(out);
  }
};

constexpr Box3i kNoKeys{Vec3i::all(2 * kKeyOffset), Vec3i::all(0)};

// Includes the set voxels of 64 neighbours, whose first has the code `code`.
void include_word(Box3i& box, std::uint64_t code, std::uint64_t word) {
  if (word == 0 || box.contains(Box3i::at(keys_of_morton(code), 4))) return;
  for (; word != 0; word &= word - 1) box.include(Box3i::at(keys_of_morton(code + __builtin_ctzll(word))));
}

class Summarizer {
 public:
  Summarizer(const OccupancyTree& tree, float threshold) : tree_(tree), threshold_(threshold) {}

  OccupancySummary run() {
    visit(tree_.root, 0, 0);
    out_.blocks = tree_.blocks.used(), out_.nodes = tree_.nodes.used();
    out_.bytes = tree_.blocks.bytes() + tree_.nodes.bytes();
    known_.low.to(out_.known_low), (known_.high - Vec3i::all(1)).to(out_.known_high);
    occupied_.low.to(out_.occupied_low), (occupied_.high - Vec3i::all(1)).to(out_.occupied_high);
    return out_;
  }

 private:
  void visit(const Cell& cell, std::uint64_t code, int depth) {
    if (cell.kind == CellKind::leaf) visit_leaf(cell.value >= threshold_, code, depth);
    if (cell.kind == CellKind::block) visit_block(tree_.blocks[cell.index], code);
    if (cell.kind != CellKind::node) return;
    for (int i = 0; i < 8; ++i)
      visit(tree_.nodes[cell.index].child[i], code | static_cast<std::uint64_t>(i) << (3 * (kKeyBits - 1 - depth)),
            depth + 1);
  }

  void visit_leaf(bool occupied, std::uint64_t code, int depth) {
    const Box3i box = Box3i::at(keys_of_morton(code), 1 << (kKeyBits - depth));
    (occupied ? out_.occupied : out_.free) += std::uint64_t{1} << (3 * (kKeyBits - depth));
    known_.include(box);
    if (occupied) occupied_.include(box);
  }

  void visit_block(const OccupancyBlock& block, std::uint64_t code) {
    for (int w = 0; w < kBlockVoxels / 64; ++w) {
      std::uint64_t occupied = 0;
      for (int i = 0; i < 64; ++i)
        occupied |= static_cast<std::uint64_t>(block.value[64 * w + i] >= threshold_) << i;
      occupied &= block.known[w];
      const int known = __builtin_popcountll(block.known[w]), full = __builtin_popcountll(occupied);
      out_.occupied += full, out_.free += known - full;
      include_word(known_, code + 64 * w, block.known[w]);
      include_word(occupied_, code + 64 * w, occupied);
    }
  }

  const OccupancyTree& tree_;
  float threshold_;
  Box3i known_ = kNoKeys, occupied_ = kNoKeys;
  OccupancySummary out_{};
};

}  // namespace

void look_up(Context& context, const OccupancyTree& tree, const float* points, std::size_t n, float threshold,
             std::int8_t* states, float* log_odds) {
  context.pool.parallel_for(n, 4096, [&](std::size_t begin, std::size_t end, int) {
    std::uint64_t last = ~std::uint64_t{0};
    Cell cell;
    for (std::size_t i = begin; i < end; ++i) {
      Vec3i key;
      float value = std::numeric_limits<float>::quiet_NaN();
      if (key_of_point(tree.grid, Vec3f::from(points + 3 * i), key)) {
        const std::uint64_t code = morton_code(key);
        if (code >> 9 != last) cell = tree.find(last = code >> 9);
        if (cell.kind == CellKind::leaf) value = cell.value;
        if (cell.kind == CellKind::block) {
          const OccupancyBlock& block = tree.blocks[cell.index];
          const int voxel = static_cast<int>(code & 511);
          if (block.known[voxel / 64] >> (voxel % 64) & 1) value = block.value[voxel];
        }
      }
      if (states) states[i] = std::isnan(value) ? kStateUnknown : value >= threshold ? kStateOccupied : kStateFree;
      if (log_odds) log_odds[i] = value;
    }
  });
}

std::vector<OccupancyLeaf> list_leaves(const OccupancyTree& tree, float threshold, int which) {
  LeafSink sink{tree.grid, threshold, which, {}};
  OccupancyWalk<LeafSink>(tree, sink).run();
  return std::move(sink.leaves);
}

OccupancySummary summarize(const OccupancyTree& tree, float threshold) { return Summarizer(tree, threshold).run(); }

}  // namespace ggslam
