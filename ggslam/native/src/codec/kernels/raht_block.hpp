// SPDX-License-Identifier: Apache-2.0
// The transform of one 2 x 2 x 2 block (ISO/IEC 23090-9, first edition): two-point transforms along z, y and x. Which
// of them there are depends on the occupied children only, so each of the 255 cases is written down once as a list.
#pragma once
#include <cstdint>

#include "codec/kernels/fixed_point.hpp"

namespace ggslam::GGSLAM_ISA::codec {

// Occupied children are numbered by slots, in Morton order. After the transform slot 0 holds the DC coefficient.
struct BlockPlan {
  std::uint8_t slots = 0, steps = 0;
  struct Step {
    std::uint8_t low, high;  // slots of the pair
  } step[12] = {};
  std::uint8_t scan[7] = {};  // slots of the AC coefficients in the order of coding; slots - 1 of them
  std::uint8_t octant[8] = {};
  std::uint8_t slot_of[8] = {};
};

inline BlockPlan make_block_plan(unsigned occupancy) {
  static constexpr std::uint8_t kPairs[12][2] = {{0, 1}, {2, 3}, {4, 5}, {6, 7}, {0, 2}, {4, 6},
                                                 {1, 3}, {5, 7}, {0, 4}, {1, 5}, {2, 6}, {3, 7}};
  static constexpr std::uint8_t kScan[8] = {0, 4, 2, 1, 6, 5, 3, 7};
  BlockPlan plan;
  int at[8];
  for (int i = 0; i < 8; ++i) {
    at[i] = -1;
    if (!(occupancy >> i & 1)) continue;
    plan.octant[plan.slots] = static_cast<std::uint8_t>(i);
    plan.slot_of[i] = plan.slots;
    at[i] = plan.slots++;
  }
  for (const auto& pair : kPairs) {
    int &low = at[pair[0]], &high = at[pair[1]];
    if (high < 0) continue;
    if (low < 0) {
      low = high, high = -1;
      continue;
    }
    plan.step[plan.steps++] = {static_cast<std::uint8_t>(low), static_cast<std::uint8_t>(high)};
  }
  int coefficients = 0;
  for (int i = 1; i < 8; ++i)
    if (at[kScan[i]] >= 0) plan.scan[coefficients++] = static_cast<std::uint8_t>(at[kScan[i]]);
  return plan;
}

struct BlockPlans {
  BlockPlan of[256];
  BlockPlans() {
    for (unsigned occupancy = 0; occupancy < 256; ++occupancy) of[occupancy] = make_block_plan(occupancy);
  }
};

inline const BlockPlans& block_plans() {
  static const BlockPlans plans;
  return plans;
}

// Values of a block by slot.
template <int Components>
struct BlockValues {
  std::int64_t v[8][Components];
};

// A plan with the factors of its steps, for the weights of one block.
class BlockTransform {
 public:
  BlockTransform(const BlockPlan& plan, const std::uint32_t* weights, const WeightTables& tables) : plan_(plan) {
    std::uint32_t w[8];
    for (int i = 0; i < plan.slots; ++i) w[i] = weights[i];
    for (int i = 0; i < plan.steps; ++i) {
      std::uint32_t &low = w[plan.step[i].low], &high = w[plan.step[i].high];
      factors_[i] = tables.butterfly(low, high);
      low = high = low + high;
    }
  }

  template <int Components>
  void forward(BlockValues<Components>& x) const {
    for (int i = 0; i < plan_.steps; ++i) {
      const std::int64_t a = factors_[i].a, b = factors_[i].b;
      std::int64_t *low = x.v[plan_.step[i].low], *high = x.v[plan_.step[i].high];
      for (int k = 0; k < Components; ++k) {
        const std::int64_t l = low[k], r = high[k];
        low[k] = multiply(l, a) + multiply(r, b);
        high[k] = multiply(r, a) - multiply(l, b);
      }
    }
  }

  template <int Components>
  void inverse(BlockValues<Components>& x) const {
    for (int i = plan_.steps - 1; i >= 0; --i) {
      const std::int64_t a = factors_[i].a, b = factors_[i].b;
      std::int64_t *low = x.v[plan_.step[i].low], *high = x.v[plan_.step[i].high];
      for (int k = 0; k < Components; ++k) {
        const std::int64_t l = low[k], h = high[k];
        low[k] = multiply(l, a) - multiply(h, b);
        high[k] = multiply(l, b) + multiply(h, a);
      }
    }
  }

 private:
  const BlockPlan& plan_;
  Butterfly factors_[12];
};

}  // namespace ggslam::GGSLAM_ISA::codec
