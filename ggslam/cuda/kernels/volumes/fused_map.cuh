// SPDX-License-Identifier: Apache-2.0
// Blocks of a map on the device, found by their coordinates.
#pragma once
#include "volumes/numbers.cuh"

namespace ggslam::cuda {

constexpr std::uint64_t kNoKey = ~std::uint64_t{0};
constexpr int kKeyBits = 21;
constexpr int kKeyOffset = 1 << (kKeyBits - 1);  // coordinates lie within this
constexpr int kListThreads = 128;                // of kernels that work on lists of blocks, one a thread

__host__ __device__ inline std::uint64_t key_of(std::int32_t x, std::int32_t y, std::int32_t z) {
  constexpr std::uint64_t kMask = (std::uint64_t{1} << kKeyBits) - 1;
  return (static_cast<std::uint64_t>(x + kKeyOffset) & kMask) |
         (static_cast<std::uint64_t>(y + kKeyOffset) & kMask) << kKeyBits |
         (static_cast<std::uint64_t>(z + kKeyOffset) & kMask) << (2 * kKeyBits);
}

// Coordinate `axis` of a key.
__device__ inline std::int32_t coordinate_of(std::uint64_t key, int axis) {
  return static_cast<std::int32_t>(key >> (kKeyBits * axis) & ((std::uint64_t{1} << kKeyBits) - 1)) - kKeyOffset;
}

__device__ inline std::uint64_t place_of(std::uint64_t key) {
  key *= 0x9E3779B97F4A7C15ull;
  key ^= key >> 32;
  key *= 0xD6E8FEB86659FD93ull;
  return key ^ (key >> 32);
}

// The row of a block, whether or not it is present; -1: none was ever made.
__device__ inline std::int32_t find_row(const FusedMap& map, std::uint64_t key) {
  const std::uint64_t mask = static_cast<std::uint64_t>(map.place_mask);
  for (std::uint64_t place = place_of(key) & mask;; place = (place + 1) & mask) {
    const std::uint64_t found = map.keys[place];
    if (found == key) return map.rows[place];
    if (found == kNoKey) return -1;
  }
}

// The row of a present block; -1: there is none.
__device__ inline std::int32_t find_block(const FusedMap& map, std::int32_t x, std::int32_t y, std::int32_t z) {
  const std::int32_t row = find_row(map, key_of(x, y, z));
  return row >= 0 && map.blocks[row].present != 0 ? row : -1;
}

// Puts a block into the table that is not there. Which of two that meet comes first depends on chance; what a look-up
// finds does not.
__device__ inline void insert_row(const FusedMap& map, std::uint64_t key, std::int32_t row) {
  const std::uint64_t mask = static_cast<std::uint64_t>(map.place_mask);
  for (std::uint64_t place = place_of(key) & mask;; place = (place + 1) & mask) {
    unsigned long long* found = reinterpret_cast<unsigned long long*>(map.keys + place);
    if (atomicCAS(found, static_cast<unsigned long long>(kNoKey), static_cast<unsigned long long>(key)) == kNoKey) {
      map.rows[place] = row;
      return;
    }
  }
}

__device__ inline bool is_stopped(const FusedMap& map) { return map.counts[kStoppedAt] != 0; }

}  // namespace ggslam::cuda
