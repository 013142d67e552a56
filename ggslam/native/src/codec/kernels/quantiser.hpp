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
  explicit Quantiser(const gpcc::RahtSettings& settings)
      : step_{quantiser_step(settings.qp), quantiser_step(settings.qp_secondary), quantiser_step(settings.qp_secondary)} {
    const auto step = static_cast<double>(step_[0]);
    bit_weight_ = static_cast<std::int64_t>(settings.rdoq * step * step);
  }

  // An encoder's choice: values are rounded up from two thirds of a step.
  std::int32_t quantise(std::int64_t value, int component) const {
    const std::int64_t step = step_[component], size = (value < 0 ? -value : value) * 256 + step / 3;
    if (size < step) return 0;
    const auto q = static_cast<std::int32_t>(size / step);
    return value < 0 ? -q : q;
  }
  std::int64_t restored(std::int32_t q, int component) const { return (q * step_[component] + 128) >> 8; }
  // The squared error, times 256, that is worth as much as these 1/256 bits.
  std::int64_t weighted_bits(std::int64_t bits) const { return bits * bit_weight_ >> 16; }

 private:
  std::int64_t step_[3];
  std::int64_t bit_weight_;  // of a bit: the setting times the squared step of component 0, in 1/65536
};

}  // namespace ggslam::GGSLAM_ISA::codec
