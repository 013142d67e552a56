// SPDX-License-Identifier: Apache-2.0
// Exponential Golomb codes of order k as bins of the arithmetic coder (ISO/IEC 23090-9, first edition): while the value
// is at least 2^k a one, then a zero, then k bits of what is left, high bit first.
#pragma once
#include <algorithm>
#include <cstdint>

#include "codec/kernels/arithmetic_coder.hpp"

namespace ggslam::GGSLAM_ISA::codec {

inline constexpr int kMaxOrder = 30;   // no value of this codec needs more; a stream that does is corrupt

template <class Coder>
void mark_corrupt(Coder&) {}
inline void mark_corrupt(BinaryDecoder& coder) { coder.mark_corrupt(); }

// prefix(i, bit) and suffix(i, bit) code one bin; i counts the bins of the prefix, and the bits of the suffix by their
// weight. Returns the value.
template <class Coder, class Prefix, class Suffix>
std::uint32_t code_exp_golomb(Coder& coder, std::uint32_t value, int order, const Prefix& prefix, const Suffix& suffix) {
  std::uint32_t base = 0;
  int k = order;
  for (;;) {
    const std::uint32_t width = std::uint32_t{1} << k;
    if (!prefix(k - order, Coder::kEncoder && value - base >= width)) break;
    base += width;
    if (++k > kMaxOrder) {
      mark_corrupt(coder);
      return 0;
    }
  }
  const std::uint32_t rest = Coder::kEncoder ? value - base : 0;
  std::uint32_t decoded = 0;
  for (int bit = k - 1; bit >= 0; --bit)
    decoded |= static_cast<std::uint32_t>(suffix(bit, static_cast<int>(rest >> bit & 1))) << bit;
  return base + decoded;
}

// One adaptive context for the prefix, equal probabilities for the suffix.
template <class Coder>
std::uint32_t code_exp_golomb(Coder& coder, std::uint32_t value, int order, Probability& prefix) {
  return code_exp_golomb(
      coder, value, order, [&](int, int bit) { return coder.code(bit, prefix); },
      [&](int, int bit) { return coder.bypass(bit); });
}

// Contexts of its own for the first bins of the prefix and for the lowest bits of the suffix.
template <class Coder>
std::uint32_t code_exp_golomb(Coder& coder, std::uint32_t value, int order, Probability (&prefix)[3],
                              Probability (&suffix)[3]) {
  return code_exp_golomb(
      coder, value, order, [&](int i, int bit) { return coder.code(bit, prefix[std::min(i, 2)]); },
      [&](int i, int bit) { return coder.code(bit, suffix[std::min(i, 2)]); });
}

}  // namespace ggslam::GGSLAM_ISA::codec
