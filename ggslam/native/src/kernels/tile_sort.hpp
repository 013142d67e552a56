// SPDX-License-Identifier: Apache-2.0
// Stable sort of a tile's entries by depth: one bucket pass over the actual range of depths, with about two buckets per
// entry, then insertion. Depths that crowd in few buckets (a near object before a far wall) are bucketed again.
#pragma once
#include "rasterizer.hpp"

namespace ggslam::GGSLAM_ISA {

constexpr std::uint32_t kInsertionLimit = 24;

static inline void insertion_sort(TileEntry* entries, std::uint32_t n) {
  for (std::uint32_t i = 1; i < n; ++i) {
    const TileEntry entry = entries[i];
    std::uint32_t j = i;
    for (; j > 0 && entries[j - 1].depth_bits > entry.depth_bits; --j) entries[j] = entries[j - 1];
    entries[j] = entry;
  }
}

// Sorts entries[0..n); temporary has room for n.
static void sort_by_depth(TileEntry* entries, TileEntry* temporary, std::uint32_t n) {
  if (n <= kInsertionLimit) return insertion_sort(entries, n);
  std::uint32_t low = entries[0].depth_bits, high = low;
  for (std::uint32_t i = 1; i < n; ++i) {
    const std::uint32_t bits = entries[i].depth_bits;
    low = bits < low ? bits : low;
    high = bits > high ? bits : high;
  }
  if (low == high) return;
  const int size_bits = 33 - __builtin_clz(n), bucket_bits = size_bits > 11 ? 11 : size_bits;
  const int range_bits = 32 - __builtin_clz(high - low);
  const int shift = range_bits > bucket_bits ? range_bits - bucket_bits : 0;

  constexpr int kMaxBuckets = 1 << 11;
  const std::uint32_t buckets = ((high - low) >> shift) + 1;
  std::uint32_t start[kMaxBuckets + 1];
  __builtin_memset(start, 0, sizeof(start[0]) * (buckets + 1));
  for (std::uint32_t i = 0; i < n; ++i) ++start[((entries[i].depth_bits - low) >> shift) + 1];
  std::uint32_t largest = 0;
  for (std::uint32_t b = 1; b <= buckets; ++b) {
    largest = start[b] > largest ? start[b] : largest;
    start[b] += start[b - 1];
  }
  for (std::uint32_t i = 0; i < n; ++i) temporary[start[(entries[i].depth_bits - low) >> shift]++] = entries[i];
  __builtin_memcpy(entries, temporary, sizeof(TileEntry) * n);
  if (shift == 0) return;
  if (largest <= kInsertionLimit) return insertion_sort(entries, n);  // every entry is already within its bucket
  for (std::uint32_t b = 0, begin = 0; b < buckets; begin = start[b++])  // start[b] is now the end of bucket b
    if (start[b] - begin > 1) sort_by_depth(entries + begin, temporary + begin, start[b] - begin);
}

}  // namespace ggslam::GGSLAM_ISA
