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

class OccupancyModel {
 public:
  explicit OccupancyModel(bool siblings_only)
      : class_of_pattern_(siblings_only ? kSiblingPatternClass : kPatternClass), tables_(occupancy_tables()) {
    std::memset(maps_, 127, sizeof maps_);
  }

  // Codes an occupancy byte (ignored by the decoder) and returns it. It is never 0.
  template <class Coder>
  unsigned code(Coder& coder, unsigned occupancy, const NodeContext& node) {
    if (node.pattern == 0) {
      const bool single = Coder::kEncoder && (occupancy & (occupancy - 1)) == 0;
      if (coder.code(single, single_child_)) return code_single(coder, occupancy);
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
        std::uint8_t& entry = maps_[map][kMapStart[bin] + map_index(bin, r, node.pattern, before)];
        bit = coder.code(occupancy >> child & 1, contexts_[entry >> 3]);
        entry = static_cast<std::uint8_t>(bit ? entry + kMapStep[(255 - entry) >> 4] : entry - kMapStep[entry >> 4]);
        zeros_left -= 1 - bit;
      }
      decoded |= static_cast<unsigned>(bit) << child;
      before |= static_cast<unsigned>(bit) << bin;
    }
    return decoded;
  }

  // Codes the number of points in a leaf, at least 1.
  template <class Coder>
  std::uint32_t code_leaf_points(Coder& coder, std::uint32_t points) {
    if (!coder.code(Coder::kEncoder && points > 1, several_points_)) return 1;
    return 2 + code_exp_golomb(coder, Coder::kEncoder ? points - 2 : 0, 0, more_points_);
  }

 private:
  static constexpr std::uint8_t kFewerAdjacent[6] = {0, 0, 1, 2, 3, 3};

  template <class Coder>
  static unsigned code_single(Coder& coder, unsigned occupancy) {
    const int child = Coder::kEncoder ? __builtin_ctz(occupancy) : 0;
    const int x = coder.bypass(child >> 2), y = coder.bypass(child >> 1 & 1), z = coder.bypass(child & 1);
    return 1u << (x << 2 | y << 1 | z);
  }

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
  Probability single_child_, contexts_[32], several_points_, more_points_;
  std::uint8_t maps_[18][604];
};

}  // namespace ggslam::GGSLAM_ISA::codec
