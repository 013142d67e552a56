// SPDX-License-Identifier: Apache-2.0
// Prediction of a block's children from the blocks around it (ISO/IEC 23090-9, first edition).
#pragma once
#include <cstdint>

#include "codec/kernels/neighbourhood.hpp"
#include "codec/kernels/raht_block.hpp"

namespace ggslam::GGSLAM_ISA::codec {

struct PredictionTables {
  std::uint64_t relevant[256] = {};  // by occupancy: bits of the neighbours (face or edge) that touch an occupied child
  std::uint8_t touched[64] = {};     // by bit of a neighbour: the children it touches
  std::uint8_t weight[64] = {};      // 2 for a face, 1 for an edge
  std::int32_t divisor[14] = {};     // 2^15 / weight, rounded; weight 4 is the block itself

  PredictionTables() {
    for (int x = 0; x < 3; ++x)
      for (int y = 0; y < 3; ++y)
        for (int z = 0; z < 3; ++z) {
          const int bit = x * 16 + y * 4 + z;
          if (bit == kCentreBit || !(kAround19 >> bit & 1)) continue;
          weight[bit] = (x == 1) + (y == 1) + (z == 1);
          for (int child = 0; child < 8; ++child)
            if (touches(x, child >> 2) && touches(y, child >> 1 & 1) && touches(z, child & 1))
              touched[bit] |= static_cast<std::uint8_t>(1 << child);
          for (int occupancy = 0; occupancy < 256; ++occupancy)
            if (occupancy & touched[bit]) relevant[occupancy] |= std::uint64_t{1} << bit;
        }
    for (int w = 4; w < 14; ++w) divisor[w] = (32768 + w / 2) / w;
  }

 private:
  static bool touches(int offset, int child) { return offset == 1 || offset == 2 * child; }
};

inline const PredictionTables& prediction_tables() {
  static const PredictionTables tables;
  return tables;
}

// A neighbour whose value differs too much lies on another surface.
inline bool is_similar(std::int64_t own, std::int64_t neighbour) {
  return 2 * own < 10 * neighbour && 10 * neighbour < 25 * own;
}

// Predicts the children in the slots of `plan`, normalised values with 15 fractional bits. `neighbours` are the bits of
// the blocks to use, index(bit) is the place of one in `values`, the reconstructed blocks of this level.
template <int Components, class Index>
void predict_children(const BlockPlan& plan, unsigned occupancy, std::uint64_t neighbours, const std::int32_t* own,
                      const std::int32_t* values, const Index& index, BlockValues<Components>& out) {
  const PredictionTables& tables = prediction_tables();
  std::int32_t sum[8][Components], weight[8];
  for (int slot = 0; slot < plan.slots; ++slot) {
    weight[slot] = 4;
    for (int k = 0; k < Components; ++k) sum[slot][k] = 4 * own[k];
  }
  for (std::uint64_t rest = neighbours; rest != 0; rest &= rest - 1) {
    const int bit = __builtin_ctzll(rest);
    const std::int32_t* value = values + static_cast<std::size_t>(index(bit)) * Components;
    if (!is_similar(own[0], value[0])) continue;
    const std::int32_t w = tables.weight[bit];
    for (unsigned children = tables.touched[bit] & occupancy; children != 0; children &= children - 1) {
      const int slot = plan.slot_of[__builtin_ctz(children)];
      weight[slot] += w;
      for (int k = 0; k < Components; ++k) sum[slot][k] += w * value[k];
    }
  }
  for (int slot = 0; slot < plan.slots; ++slot)
    for (int k = 0; k < Components; ++k)
      out.v[slot][k] = static_cast<std::int64_t>(sum[slot][k]) * tables.divisor[weight[slot]];
}

}  // namespace ggslam::GGSLAM_ISA::codec
