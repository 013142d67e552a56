// SPDX-License-Identifier: Apache-2.0
// Stable sort of a tile's entries by depth: two counting passes over the depths' range in 65536 steps, which leaves few
// neighbours to exchange, then insertion. Depths that crowd in few steps (something near before a far wall) would make
// insertion slow; then two more counting passes over all their bits do the rest.
#pragma once
#include "rendering/rasterizer.hpp"

namespace ggslam::GGSLAM_ISA {

constexpr int kDigitBits = 8, kDigits = 1 << kDigitBits;

// Insertion sort that gives up, with the entries in a stable order still, after `budget` moves. True if done.
static inline bool insertion_sort(TileEntry* entries, std::uint32_t n, std::int64_t budget) {
  for (std::uint32_t i = 1; i < n; ++i) {
    const TileEntry entry = entries[i];
    if (__builtin_expect(entries[i - 1].depth_bits <= entry.depth_bits, 1)) continue;
    std::uint32_t j = i;
    for (; j > 0 && entries[j - 1].depth_bits > entry.depth_bits; --j) entries[j] = entries[j - 1];
    entries[j] = entry;
    budget -= i - j;
    if (budget < 0) return false;
  }
  return true;
}

// One stable counting pass by the digit of (depth - low) at `shift`.
static inline void counting_pass(const TileEntry* from, TileEntry* to, std::uint32_t n, std::uint32_t low, int shift,
                                 std::uint32_t* counts) {
  std::uint32_t next = 0;
  for (int digit = 0; digit < kDigits; ++digit) {
    const std::uint32_t here = counts[digit];
    counts[digit] = next;
    next += here;
  }
  for (std::uint32_t i = 0; i < n; ++i)
    to[counts[((from[i].depth_bits - low) >> shift) & (kDigits - 1)]++] = from[i];
}

// Sorts by the 16 bits of (depth - low) from `shift` on.
static inline void sort_by_two_digits(TileEntry* entries, TileEntry* temporary, std::uint32_t n, std::uint32_t low,
                                      int shift) {
  std::uint32_t lower[kDigits] = {}, upper[kDigits] = {};
  for (std::uint32_t i = 0; i < n; ++i) {
    const std::uint32_t key = (entries[i].depth_bits - low) >> shift;
    ++lower[key & (kDigits - 1)];
    ++upper[(key >> kDigitBits) & (kDigits - 1)];
  }
  counting_pass(entries, temporary, n, low, shift, lower);
  counting_pass(temporary, entries, n, low, shift + kDigitBits, upper);
}

// Sorts entries[0..n); temporary has room for n.
static void sort_by_depth(TileEntry* entries, TileEntry* temporary, std::uint32_t n) {
  if (n < 32) {
    insertion_sort(entries, n, std::int64_t{1} << 20);
    return;
  }
  std::uint32_t low = entries[0].depth_bits, high = low;
  for (std::uint32_t i = 1; i < n; ++i) {
    const std::uint32_t bits = entries[i].depth_bits;
    low = bits < low ? bits : low;
    high = bits > high ? bits : high;
  }
  if (low == high) return;
  const int range_bits = 32 - __builtin_clz(high - low), shift = range_bits > 16 ? range_bits - 16 : 0;
  sort_by_two_digits(entries, temporary, n, low, shift);
  if (shift == 0 || insertion_sort(entries, n, 4 * static_cast<std::int64_t>(n))) return;
  sort_by_two_digits(entries, temporary, n, low, 0);
  sort_by_two_digits(entries, temporary, n, low, 16);
}

}  // namespace ggslam::GGSLAM_ISA
