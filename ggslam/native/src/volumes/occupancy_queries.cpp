// SPDX-License-Identifier: Apache-2.0
#include "volumes/occupancy_queries.hpp"

#include <algorithm>
#include <limits>

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
    int key[3];
    keys_of_morton(code, key);
    OccupancyLeaf out{{}, static_cast<float>(size), v};
    for (int a = 0; a < 3; ++a) out.centre[a] = static_cast<float>((key[a] - kKeyOffset) * grid.resolution + size / 2);
    leaves.push_back(out);
  }
};

void extend(std::int32_t low[3], std::int32_t high[3], std::uint64_t code, int edge) {
  int key[3];
  keys_of_morton(code, key);
  for (int a = 0; a < 3; ++a) {
    low[a] = std::min(low[a], key[a]);
    high[a] = std::max(high[a], key[a] + edge - 1);
  }
}

// The box of the set voxels of 64 neighbours, whose first has the code `code`.
void extend_by_word(std::int32_t low[3], std::int32_t high[3], std::uint64_t code, std::uint64_t word) {
  if (word == 0) return;
  int key[3];
  keys_of_morton(code, key);
  bool inside = true;
  for (int a = 0; a < 3; ++a) inside &= key[a] >= low[a] && key[a] + 3 <= high[a];
  if (inside) return;
  for (; word != 0; word &= word - 1) extend(low, high, code + __builtin_ctzll(word), 1);
}

class Summarizer {
 public:
  Summarizer(const OccupancyTree& tree, float threshold) : tree_(tree), threshold_(threshold) {
    for (int a = 0; a < 3; ++a) {
      out_.known_low[a] = out_.occupied_low[a] = 2 * kKeyOffset;
      out_.known_high[a] = out_.occupied_high[a] = -1;
    }
  }

  OccupancySummary run() {
    visit(tree_.root, 0, 0);
    out_.blocks = tree_.blocks.used(), out_.nodes = tree_.nodes.used();
    out_.bytes = tree_.blocks.bytes() + tree_.nodes.bytes();
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
    const int edge = 1 << (kKeyBits - depth);
    (occupied ? out_.occupied : out_.free) += std::uint64_t{1} << (3 * (kKeyBits - depth));
    extend(out_.known_low, out_.known_high, code, edge);
    if (occupied) extend(out_.occupied_low, out_.occupied_high, code, edge);
  }

  void visit_block(const OccupancyBlock& block, std::uint64_t code) {
    for (int w = 0; w < kBlockVoxels / 64; ++w) {
      std::uint64_t occupied = 0;
      for (int i = 0; i < 64; ++i)
        occupied |= static_cast<std::uint64_t>(block.value[64 * w + i] >= threshold_) << i;
      occupied &= block.known[w];
      const int known = __builtin_popcountll(block.known[w]), full = __builtin_popcountll(occupied);
      out_.occupied += full, out_.free += known - full;
      extend_by_word(out_.known_low, out_.known_high, code + 64 * w, block.known[w]);
      extend_by_word(out_.occupied_low, out_.occupied_high, code + 64 * w, occupied);
    }
  }

  const OccupancyTree& tree_;
  float threshold_;
  OccupancySummary out_{};
};

}  // namespace

void look_up(Context& context, const OccupancyTree& tree, const float* points, std::size_t n, float threshold,
             std::int8_t* states, float* log_odds) {
  context.pool.parallel_for(n, 4096, [&](std::size_t begin, std::size_t end, int) {
    std::uint64_t last = ~std::uint64_t{0};
    Cell cell;
    for (std::size_t i = begin; i < end; ++i) {
      int key[3];
      float value = std::numeric_limits<float>::quiet_NaN();
      if (key_of_point(tree.grid, points + 3 * i, key)) {
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
