// SPDX-License-Identifier: Apache-2.0
// Coding of quantised attribute coefficients (ISO/IEC 23090-9, first edition): runs of zeros, then one coefficient per
// component, not all of them zero.
#pragma once
#include <cstdint>
#include <cstdlib>

#include "codec/kernels/exp_golomb.hpp"

namespace ggslam::GGSLAM_ISA::codec {

template <int Components>
struct Coefficients {
  std::int32_t c[Components];

  bool zero() const {
    std::int32_t any = 0;
    for (const std::int32_t v : c) any |= v;
    return any == 0;
  }
};

// The contexts, and the order of bins, for both directions.
template <int Components>
class CoefficientModel {
 public:
  template <class Coder>
  std::uint32_t code_run(Coder& coder, std::uint32_t run) {
    for (std::uint32_t i = 0; i < 3; ++i)
      if (!coder.code(Coder::kEncoder && run > i, run_[i])) return i;
    for (std::uint32_t base = 3; base < 11; base += 2)
      if (!coder.code(Coder::kEncoder && run >= base + 2, run_[3]))
        return base + coder.bypass(static_cast<int>(run - base));
    return 11 + code_exp_golomb(coder, Coder::kEncoder ? run - 11 : 0, 2, run_[4]);
  }

  template <class Coder>
  void code(Coder& coder, Coefficients<Components>& q) {
    if constexpr (Components == 1) {
      const std::uint32_t size = 1 + code_size(coder, magnitude<Coder>(q.c[0]) - 1, 0, 0, 0);
      q.c[0] = code_sign(coder, q.c[0], size);
    } else {
      const std::uint32_t size1 = code_size(coder, magnitude<Coder>(q.c[1]), 0, 0, 1);
      q.c[1] = code_sign(coder, q.c[1], size1);
      const int zero1 = size1 == 0, small1 = size1 <= 1;
      const std::uint32_t size2 = code_size(coder, magnitude<Coder>(q.c[2]), 1 + zero1, 1 + small1, 1);
      q.c[2] = code_sign(coder, q.c[2], size2);
      const int zero2 = size2 == 0, small2 = size2 <= 1;
      const std::uint32_t known = zero1 && zero2;  // then component 0 is not zero
      const std::uint32_t size0 =
          known + code_size(coder, magnitude<Coder>(q.c[0]) - known, 3 + 2 * zero1 + zero2, 3 + 2 * small1 + small2, 0);
      q.c[0] = code_sign(coder, q.c[0], size0);
    }
  }

 private:
  template <class Coder>
  static std::uint32_t magnitude(std::int32_t v) { return Coder::kEncoder ? static_cast<std::uint32_t>(std::abs(v)) : 0; }

  template <class Coder>
  std::uint32_t code_size(Coder& coder, std::uint32_t size, int zero_context, int one_context, int set) {
    if (!coder.code(Coder::kEncoder && size > 0, above_zero_[zero_context])) return 0;
    if (!coder.code(Coder::kEncoder && size > 1, above_one_[one_context])) return 1;
    return 2 + code_exp_golomb(coder, Coder::kEncoder ? size - 2 : 0, 1, prefix_[set], suffix_[set]);
  }
  template <class Coder>
  static std::int32_t code_sign(Coder& coder, std::int32_t value, std::uint32_t size) {
    if (size == 0) return 0;
    const auto v = static_cast<std::int32_t>(size);
    return coder.bypass(Coder::kEncoder && value < 0) ? -v : v;
  }

  Probability run_[5], above_zero_[7], above_one_[7], prefix_[2][3], suffix_[2][3];
};

// Bits of a run of zeros, about.
inline int run_bits(std::uint32_t run) {
  static constexpr std::uint8_t kBits[11] = {1, 2, 3, 5, 5, 7, 7, 9, 9, 11, 11};
  return run < 11 ? kBits[run] : 12 + 2 * (32 - __builtin_clz(run - 10));
}

template <int Components>
class CoefficientWriter {
 public:
  static constexpr bool kEncoder = true;
  explicit CoefficientWriter(BinaryEncoder& coder) : coder_(coder) {}

  void code(Coefficients<Components>& q) {
    if (q.zero()) {
      ++run_;
      return;
    }
    model_.code_run(coder_, run_);
    model_.code(coder_, q);
    run_ = 0;
  }
  std::uint32_t run() const { return run_; }  // zeros since the last coefficient
  void finish() {
    if (run_ > 0) model_.code_run(coder_, run_);
  }
  bool failed() const { return false; }

 private:
  BinaryEncoder& coder_;
  CoefficientModel<Components> model_;
  std::uint32_t run_ = 0;
};

template <int Components, class Decoder = BinaryDecoder>
class CoefficientReader {
 public:
  static constexpr bool kEncoder = false;
  explicit CoefficientReader(Decoder& coder) : coder_(coder) {}

  CoefficientModel<Components>& model() { return model_; }

  void code(Coefficients<Components>& q) {
    if (!have_run_) run_ = model_.code_run(coder_, 0), have_run_ = true;
    if (run_ > 0) {
      --run_;
      q = {};
      return;
    }
    have_run_ = false;
    model_.code(coder_, q);
  }
  bool failed() const { return coder_.failed(); }

 private:
  Decoder& coder_;
  CoefficientModel<Components> model_;
  std::uint32_t run_ = 0;
  bool have_run_ = false;
};

}  // namespace ggslam::GGSLAM_ISA::codec
