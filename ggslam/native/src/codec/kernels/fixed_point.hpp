// SPDX-License-Identifier: Apache-2.0
// Arithmetic of the region-adaptive hierarchical transform (ISO/IEC 23090-9, first edition): numbers with 15 fractional
// bits, and integer square roots that every decoder must get exactly alike.
// Compiled with -fwrapv: on made-up coefficients values overflow, which must be harmless, not undefined.
#pragma once
#include <cstdint>

namespace ggslam::GGSLAM_ISA::codec {

inline constexpr int kFractionBits = 15;
inline constexpr std::int64_t kHalf = std::int64_t{1} << (kFractionBits - 1);

// Drops the fraction, rounding halves away from zero.
inline std::int64_t rounded(std::int64_t value) { return (value + kHalf + (value >> 63)) >> kFractionBits; }

inline std::int64_t multiply(std::int64_t a, std::int64_t b) { return rounded(a * b); }

inline constexpr std::uint32_t kThreeR[96] = {
    3196059648u, 3145728000u, 3107979264u, 3057647616u, 3019898880u, 2969567232u, 2931818496u, 2894069760u,
    2868903936u, 2831155200u, 2793406464u, 2768240640u, 2730491904u, 2705326080u, 2667577344u, 2642411520u,
    2617245696u, 2592079872u, 2566914048u, 2541748224u, 2516582400u, 2491416576u, 2466250752u, 2441084928u,
    2428502016u, 2403336192u, 2378170368u, 2365587456u, 2340421632u, 2327838720u, 2302672896u, 2290089984u,
    2264924160u, 2252341248u, 2239758336u, 2214592512u, 2202009600u, 2189426688u, 2164260864u, 2151677952u,
    2139095040u, 2126512128u, 2113929216u, 2101346304u, 2088763392u, 2076180480u, 2051014656u, 2038431744u,
    2025848832u, 2013265920u, 2000683008u, 2000683008u, 1988100096u, 1962934272u, 1962934272u, 1950351360u,
    1937768448u, 1925185536u, 1912602624u, 1900019712u, 1900019712u, 1887436800u, 1874853888u, 1862270976u,
    1849688064u, 1849688064u, 1837105152u, 1824522240u, 1811939328u, 1811939328u, 1799356416u, 1786773504u,
    1786773504u, 1774190592u, 1761607680u, 1761607680u, 1749024768u, 1736441856u, 1736441856u, 1723858944u,
    1723858944u, 1711276032u, 1698693120u, 1698693120u, 1686110208u, 1686110208u, 1673527296u, 1660944384u,
    1660944384u, 1648361472u, 1648361472u, 1635778560u, 1635778560u, 1623195648u, 1623195648u, 1610612736u};
inline constexpr std::uint32_t kCubedR[96] = {
    4195081216u, 3999986688u, 3857709056u, 3673323520u, 3538940928u, 3364924416u, 3238224896u, 3114735616u,
    3034196992u, 2915990528u, 2800922624u, 2725880832u, 2615890944u, 2544223232u, 2439185408u, 2370818048u,
    2303728640u, 2237913088u, 2173355008u, 2110061568u, 2048008192u, 1987165184u, 1927563264u, 1869150208u,
    1840392192u, 1783783424u, 1728321536u, 1701024768u, 1647311872u, 1620883456u, 1568898048u, 1543306240u,
    1492993024u, 1468236800u, 1443762176u, 1395656704u, 1372007424u, 1348605952u, 1302626304u, 1280060416u,
    1257736192u, 1235650560u, 1213861888u, 1192294400u, 1171008512u, 1149979648u, 1108673536u, 1088379904u,
    1068352512u, 1048567808u, 1029031936u, 1029036032u, 1009729536u, 971888640u, 971882496u, 953319424u, 934993920u,
    916897792u, 899011584u, 881389568u, 881392640u, 864009216u, 846846976u, 829900800u, 813182976u, 813201408u,
    796721152u, 780459008u, 764412928u, 764417024u, 748601344u, 732995584u, 733017088u, 717624320u, 702468096u,
    702466048u, 687520768u, 672786432u, 672787456u, 658258944u, 658256896u, 643947520u, 629854208u, 629862400u,
    615976960u, 615952384u, 602276864u, 588779520u, 588804096u, 575512576u, 575526912u, 562433024u, 562439168u,
    549556224u, 549564416u, 536876032u};

// About 2^40 / sqrt(a), 0 for 0: a table gives 3r and r^3 for the first step r' = (3r - a r^3) / 2, one Newton step
// follows.
inline std::uint64_t inverse_square_root(std::uint64_t a) {
  if (a == 0) return 0;
  int shift = -3;
  while (a >> 32) a >>= 2, --shift;
  while (!(a & 0xc0000000u)) a <<= 2, ++shift;
  const std::uint32_t index = static_cast<std::uint32_t>(a >> 25) - 32;
  std::uint64_t r = kThreeR[index] - (kCubedR[index] * a >> 32);
  const std::uint64_t ar = r * a >> 32;
  r = r * (0x30000000 - (r * ar >> 32)) >> 32;
  return shift > 0 ? r << shift : r >> -shift;
}

// About sqrt(a), above it by one at times. Above 2^46 (weights of more than 65,536) the argument loses its low bits
// first. The first version of this codec kept them there; its streams are read with `kept`.
inline std::uint64_t square_root(std::uint64_t a, bool kept = false) {
  if (a <= std::uint64_t{1} << 46) return 1 + (a * inverse_square_root(a) >> 40);
  const std::uint64_t high = (a + 65536) >> 16;
  if (kept) return 1 + (high * inverse_square_root(a) >> 24);
  return 1 + (high * inverse_square_root(high) >> 32);
}

// What the transform needs of a weight, by table for the small ones.
struct WeightRoots {
  std::int64_t root;      // sqrt(weight), 15 fractional bits
  std::int64_t inverse;   // 1 / sqrt(weight), 15 + shift fractional bits
  int shift;              // large numbers are shifted down by this before they are multiplied by `inverse`
};

inline WeightRoots compute_weight_roots(std::uint32_t weight, bool kept) {
  const int shift = weight > 1024 ? (31 - __builtin_clz(weight - 1)) >> 1 : 0;
  return {static_cast<std::int64_t>(square_root(static_cast<std::uint64_t>(weight) << 30, kept)),
          static_cast<std::int64_t>(inverse_square_root(weight) >> (40 - shift - kFractionBits)), shift};
}

// Factors of the two-point transform of values with these weights: low = a l + b r, high = a r - b l.
struct Butterfly {
  std::int32_t a, b;
};

inline Butterfly compute_butterfly(std::uint32_t left, std::uint32_t right, bool kept) {
  const std::uint64_t inverse = inverse_square_root(static_cast<std::uint64_t>(left) + right);
  return {static_cast<std::int32_t>(square_root(static_cast<std::uint64_t>(left) << 30, kept) * inverse >> 40),
          static_cast<std::int32_t>(square_root(static_cast<std::uint64_t>(right) << 30, kept) * inverse >> 40)};
}

class WeightTables {
 public:
  explicit WeightTables(bool kept) : kept_(kept) {
    for (std::uint32_t w = 1; w < kRoots; ++w) roots_[w] = compute_weight_roots(w, kept);
    for (std::uint32_t l = 1; l < kPairs; ++l)
      for (std::uint32_t r = 1; r < kPairs; ++r) butterflies_[l][r] = compute_butterfly(l, r, kept);
  }
  WeightRoots roots(std::uint32_t weight) const {
    return weight < kRoots ? roots_[weight] : compute_weight_roots(weight, kept_);
  }
  Butterfly butterfly(std::uint32_t left, std::uint32_t right) const {
    return left < kPairs && right < kPairs ? butterflies_[left][right] : compute_butterfly(left, right, kept_);
  }

 private:
  static constexpr std::uint32_t kRoots = 512, kPairs = 40;
  WeightRoots roots_[kRoots] = {};
  Butterfly butterflies_[kPairs][kPairs] = {};
  bool kept_;
};

// `kept`: as in square_root.
inline const WeightTables& weight_tables(bool kept) {
  static const WeightTables standard(false), first_version(true);
  return kept ? first_version : standard;
}

}  // namespace ggslam::GGSLAM_ISA::codec
