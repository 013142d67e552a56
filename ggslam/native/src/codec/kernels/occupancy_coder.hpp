// SPDX-License-Identifier: Apache-2.0
// Coding of one node's occupancy byte, bin by bin (ISO/IEC 23090-9, first edition). Each bin has a map entry, chosen by
// what is known of the neighbours and of the bins before it; the entry's value chooses one of 32 adaptive contexts.
#pragma once
#include <cstdint>
#include <cstring>

#include "codec/kernels/exp_golomb.hpp"
#include "codec/kernels/occupancy_tables.hpp"

namespace ggslam::GGSLAM_ISA::codec {

// The order in which the children of a node are visited, by its neighbour pattern, and other tables of bytes.
struct OccupancyTables {
  std::uint8_t child_order[64][8] = {};
  std::uint64_t bytes[256] = {};  // bit i of the index as byte i

  OccupancyTables() {
    for (int pattern = 0; pattern < 64; ++pattern)
      for (int bin = 0; bin < 8; ++bin)
        for (int child = 0; child < 8; ++child)
          if (kOctantPermutation[pattern][child] - '0' == kBinOrder[bin])
            child_order[pattern][bin] = static_cast<std::uint8_t>(child);
    for (int i = 0; i < 256; ++i)
      for (int bit = 0; bit < 8; ++bit) bytes[i] |= static_cast<std::uint64_t>(i >> bit & 1) << (8 * bit);
  }
};

inline const OccupancyTables& occupancy_tables() {
  static const OccupancyTables tables;
  return tables;
}

// What is known of a node's children before its occupancy is coded; bit i belongs to child i.
struct NodeContext {
  unsigned pattern = 0;          // occupied face neighbours
  unsigned touched = 0;          // children touching an occupied child of a coded neighbour...
  unsigned touched_again = 0;    // ...or two of them
  unsigned open = 0;             // children touching an empty child of a coded, occupied neighbour
  unsigned predicted_any = 0;    // children predicted from the 26 neighbours...
  unsigned predicted_full = 0;   // ...to be occupied
};

// The state that coding adapts.
struct OccupancyContexts {
  Probability single_child, occupancy[32], several_points, more_points;
  std::uint8_t maps[18][604];

  OccupancyContexts() { std::memset(maps, 127, sizeof maps); }
};

// What planes say of a node's children: along axis k they lie in one half (`known`: the children that are not in it, 0 if
// that is not known), or they may (`possible`).
struct PlaneKnowledge {
  unsigned known[3] = {0, 0, 0};
  bool possible[3] = {true, true, true};
};

class OccupancyModel {
 public:
  explicit OccupancyModel(bool siblings_only)
      : class_of_pattern_(siblings_only ? kSiblingPatternClass : kPatternClass), tables_(occupancy_tables()) {}

  OccupancyContexts& contexts() { return own_; }

  // Codes an occupancy byte (ignored by the decoder) and returns it. It is never 0.
  template <class Coder>
  unsigned code(Coder& coder, unsigned occupancy, const NodeContext& node) {
    if (node.pattern == 0) {
      const bool single = Coder::kEncoder && (occupancy & (occupancy - 1)) == 0;
      if (coder.code(single, own_.single_child)) return code_single(coder, occupancy);
    }
    const int r = class_of_pattern_[node.pattern];
    const std::uint64_t adjacency =
        tables_.bytes[node.open] + 2 * (tables_.bytes[node.touched] + tables_.bytes[node.touched_again]);
    const std::uint64_t prediction = tables_.bytes[node.predicted_any] + tables_.bytes[node.predicted_full];
    const std::uint8_t* order = tables_.child_order[node.pattern];
    int zeros_left = node.pattern == 0 ? 6 : 7;
    unsigned decoded = 0, before = 0;  // children so far; the same as bins
    for (int bin = 0; bin < 8; ++bin) {
      const int child = order[bin];
      int bit = 1;
      if (zeros_left > 0) {
        const int adjacent = adjacency >> (8 * child) & 0xff, predicted = prediction >> (8 * child) & 0xff;
        const int map = 3 * (bin > 4 ? kFewerAdjacent[adjacent] : adjacent) + predicted;
        std::uint8_t& entry = own_.maps[map][kMapStart[bin] + map_index(bin, r, node.pattern, before)];
        bit = coder.code(occupancy >> child & 1, own_.occupancy[entry >> 3]);
        entry = static_cast<std::uint8_t>(bit ? entry + kMapStep[(255 - entry) >> 4] : entry - kMapStep[entry >> 4]);
        zeros_left -= 1 - bit;
      }
      decoded |= static_cast<unsigned>(bit) << child;
      before |= static_cast<unsigned>(bit) << bin;
    }
    return decoded;
  }

  // The same where planes are known of, or a node is not split along every axis (its children lie in the lower half).
  template <class Coder>
  unsigned code_with_planes(Coder& coder, unsigned occupancy, const NodeContext& node, const PlaneKnowledge& planes) {
    const unsigned* known = planes.known;
    const unsigned excluded = known[0] | known[1] | known[2];
    const bool all_possible = planes.possible[0] && planes.possible[1] && planes.possible[2];
    if (excluded == 0 && all_possible) return code(coder, occupancy, node);
    if (known[0] && known[1] && known[2]) return 1u << corner(known);
    if (node.pattern == 0) {
      const bool single = Coder::kEncoder && (occupancy & (occupancy - 1)) == 0;
      if (all_possible && coder.code(single, own_.single_child)) return code_single(coder, occupancy, known);
      for (int axis = 0; axis < 3; ++axis)  // two children, along the axis whose plane is not known
        if (known[(axis + 1) % 3] && known[(axis + 2) % 3] && !known[axis])
          return (1u << corner(known)) | (1u << (corner(known) | 4u >> axis));
    }
    return code_bins(coder, occupancy, node, planes, excluded);
  }

  // Codes the number of points in a leaf, at least 1.
  template <class Coder>
  std::uint32_t code_leaf_points(Coder& coder, std::uint32_t points) {
    if (!coder.code(Coder::kEncoder && points > 1, own_.several_points)) return 1;
    return 2 + code_exp_golomb(coder, Coder::kEncoder ? points - 2 : 0, 0, own_.more_points);
  }

 private:
  static constexpr std::uint8_t kFewerAdjacent[6] = {0, 0, 1, 2, 3, 3};

  // The child in all known halves, the lower one where none is known.
  static unsigned corner(const unsigned* known) {
    return (known[0] & 1) << 2 | (known[1] & 1) << 1 | (known[2] & 1);
  }

  template <class Coder>
  static unsigned code_single(Coder& coder, unsigned occupancy) {
    const int child = Coder::kEncoder ? __builtin_ctz(occupancy) : 0;
    const int x = coder.bypass(child >> 2), y = coder.bypass(child >> 1 & 1), z = coder.bypass(child & 1);
    return 1u << (x << 2 | y << 1 | z);
  }
  template <class Coder>
  static unsigned code_single(Coder& coder, unsigned occupancy, const unsigned* known) {
    const unsigned child = Coder::kEncoder ? __builtin_ctz(occupancy) : 0;
    unsigned decoded = 0;
    for (int axis = 0; axis < 3; ++axis) {
      const int shift = 2 - axis;
      const unsigned bit = known[axis] ? known[axis] & 1 : coder.bypass(static_cast<int>(child >> shift & 1));
      decoded |= bit << shift;
    }
    return 1u << decoded;
  }

  template <class Coder>
  unsigned code_bins(Coder& coder, unsigned occupancy, const NodeContext& node, const PlaneKnowledge& planes,
                     unsigned excluded) {
    const int r = class_of_pattern_[node.pattern];
    const std::uint8_t* order = tables_.child_order[node.pattern];
    ZeroCounts zeros(node.pattern == 0, planes);
    for (unsigned rest = excluded; rest != 0; rest &= rest - 1) zeros.add(__builtin_ctz(rest));
    unsigned decoded = 0, before = 0;
    for (int bin = 0; bin < 8; ++bin) {
      const int child = order[bin];
      if (excluded >> child & 1) continue;
      int bit = 1;
      if (!zeros.imply_one(child)) {
        const int adjacent = static_cast<int>((node.open >> child & 1) +
                                              2 * ((node.touched >> child & 1) + (node.touched_again >> child & 1)));
        int map = 3 * (bin > 4 ? kFewerAdjacent[adjacent] : adjacent);
        if (excluded == 0) map += (node.predicted_any >> child & 1) + (node.predicted_full >> child & 1);
        std::uint8_t& entry = own_.maps[map][kMapStart[bin] + map_index(bin, r, node.pattern, before)];
        bit = coder.code(occupancy >> child & 1, own_.occupancy[entry >> 3]);
        entry = static_cast<std::uint8_t>(bit ? entry + kMapStep[(255 - entry) >> 4] : entry - kMapStep[entry >> 4]);
        if (bit == 0) zeros.add(child);
      }
      decoded |= static_cast<unsigned>(bit) << child;
      before |= static_cast<unsigned>(bit) << bin;
    }
    return decoded;
  }

  // Empty children by axis and half. A child is there for certain when a half that cannot be empty has no other left.
  class ZeroCounts {
   public:
    ZeroCounts(bool alone, const PlaneKnowledge& planes) : most_(alone ? 6 : 7) {
      for (int axis = 0; axis < 3; ++axis) {
        sure_[axis] = planes.known[axis] || !planes.possible[axis];
        most_of_half_[axis] = alone && planes.known[axis] ? 2 : 3;
      }
    }
    void add(int child) {
      ++total_;
      for (int axis = 0; axis < 3; ++axis) ++of_half_[axis][child >> (2 - axis) & 1];
    }
    bool imply_one(int child) const {
      if (total_ >= most_) return true;
      for (int axis = 0; axis < 3; ++axis)
        if (sure_[axis] && of_half_[axis][child >> (2 - axis) & 1] >= most_of_half_[axis]) return true;
      return false;
    }

   private:
    int most_, total_ = 0, most_of_half_[3], of_half_[3][2] = {};
    bool sure_[3];
  };

  static int map_index(int bin, int r, unsigned pattern, unsigned before) {
    if (pattern == 0) return __builtin_popcount(before);
    const int partial = static_cast<int>(before);
    if (bin < 4) return ((r - 1) << bin) + partial + bin + 1;
    if (bin < 6) return ((kClassOfFive[r] - 1) << bin) + partial + bin + 1;
    if (bin == 6) return ((kClassOfThree[r] - 1) << 6) + partial + 7;
    return partial + 8;
  }

  const std::uint8_t* class_of_pattern_;
  const OccupancyTables& tables_;
  OccupancyContexts own_;
};

}  // namespace ggslam::GGSLAM_ISA::codec
