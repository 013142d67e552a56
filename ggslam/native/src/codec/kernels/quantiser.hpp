// SPDX-License-Identifier: Apache-2.0
// Quantisation of attribute coefficients (ISO/IEC 23090-9, first edition): step 256 2^((qp - 4) / 6) in 1/256.
#pragma once
#include <cstdint>

#include "codec/gpcc.hpp"

namespace ggslam::GGSLAM_ISA::codec {

inline std::int64_t quantiser_step(int qp) {
  static constexpr std::int32_t kSteps[6] = {161, 181, 203, 228, 256, 287};
  return static_cast<std::int64_t>(kSteps[qp % 6]) << (qp / 6);
}

class Quantiser {
 public:
  // `layer`: level of the tree from the root.
  Quantiser(const gpcc::RahtSettings& settings, int layer) {
    const int layers = settings.layers;
    for (int k = 0; k < 3; ++k) {
      int qp = k == 0 ? settings.qp : settings.qp_secondary;
      if (layers > 0) qp = settings.layer_qps[layer < layers ? layer : layers - 1][k > 0];
      step_[k] = quantiser_step(qp);
      const std::int64_t unshifted = quantiser_step(qp % 6);
      inverse_[k] = qp <= kFineInverse ? ((std::int64_t{1} << kInverseBits) + unshifted / 2) / unshifted >> (qp / 6) : 0;
    }
    bit_weight_ = static_cast<std::int64_t>(settings.rdoq * static_cast<double>(step_[0] * step_[0]));
  }

  // An encoder's choice: values are rounded up from two thirds of a step. Up to the coarsest step of 8 bits the inverse
  // is the reference encoder's; above, where it has few bits left, sizes are divided.
  std::int32_t quantise(std::int64_t value, int component) const {
    const std::int64_t size = (value < 0 ? -value : value) * 256, step = step_[component];
    std::int64_t q;
    if (inverse_[component] != 0)
      q = (size * inverse_[component] + (std::int64_t{1} << kInverseBits) / 3) >> kInverseBits;
    else
      q = (size + step / 3) / step;
    return static_cast<std::int32_t>(value < 0 ? -q : q);
  }
  std::int64_t restored(std::int32_t q, int component) const { return (q * step_[component] + 128) >> 8; }
  // The squared error, times 2^26, that is worth as much as these bits.
  std::int64_t weighted_bits(int bits, int components) const { return bits * (components == 1 ? 25 : 35) * bit_weight_; }

 private:
  static constexpr int kInverseBits = 26, kFineInverse = 51;

  std::int64_t step_[3], inverse_[3];
  std::int64_t bit_weight_;  // the setting times the squared step of component 0
};

}  // namespace ggslam::GGSLAM_ISA::codec
