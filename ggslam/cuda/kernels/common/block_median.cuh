// SPDX-License-Identifier: Apache-2.0
// Sums and medians by one block. Numbers are positive floats, whose bits are in the order of their values: the bits of a
// median are found one by one.
#pragma once
#include "common/platform.cuh"

namespace ggslam::cuda {

constexpr int kMedianThreads = 1024;
constexpr std::uint32_t kLeftOut = ~std::uint32_t{0};

// Sum of `value` over the block; `room` is shared memory.
template <int kThreads>
__device__ inline unsigned sum_over_block(unsigned value, unsigned (&room)[kThreads / kWarp]) {
  const unsigned of_warp = __reduce_add_sync(kAllLanes, value);
  if (threadIdx.x % kWarp == 0) room[threadIdx.x / kWarp] = of_warp;
  __syncthreads();
  unsigned sum = 0;
#pragma unroll
  for (int w = 0; w < kThreads / kWarp; ++w) sum += room[w];
  __syncthreads();
  return sum;
}

// Bits of the lower of the two middle ones of the `used` numbers among places 0 to n - 1 whose bits are not kLeftOut. All
// threads of the block, which has kMedianThreads, get it.
template <class Bits>
__device__ inline std::uint32_t block_lower_median(int n, int used, const Bits& bits_of,
                                                   unsigned (&room)[kMedianThreads / kWarp]) {
  const unsigned rank = static_cast<unsigned>(max(used - 1, 0) / 2);
  std::uint32_t lower = 0;  // the largest value that at most `rank` numbers are below
  for (int bit = 30; bit >= 0; --bit) {
    const std::uint32_t candidate = lower | std::uint32_t{1} << bit;
    unsigned below = 0;
    for (int i = static_cast<int>(threadIdx.x); i < n; i += kMedianThreads) below += bits_of(i) < candidate;
    if (sum_over_block<kMedianThreads>(below, room) <= rank) lower = candidate;
  }
  return lower;
}

// Median of the same numbers, the mean of the two middle ones if they are even in number; 0 without any. Only thread 0
// gets it.
template <class Bits>
__device__ inline float block_median(int n, int used, const Bits& bits_of, unsigned (&room)[kMedianThreads / kWarp]) {
  const int thread = static_cast<int>(threadIdx.x);
  const std::uint32_t lower = block_lower_median(n, used, bits_of, room);
  // Its upper neighbour in order: the same value if it is there often enough, else the least of the larger ones.
  unsigned up_to = 0;
  std::uint32_t above = 0x7f7fffffu;
  for (int i = thread; i < n; i += kMedianThreads) {
    const std::uint32_t value = bits_of(i);
    up_to += value <= lower;
    if (value > lower) above = min(above, value);
  }
  const bool repeated = sum_over_block<kMedianThreads>(up_to, room) > static_cast<unsigned>(used / 2);
  const int least = -__reduce_max_sync(kAllLanes, -static_cast<int>(above));
  if (thread % kWarp == 0) room[thread / kWarp] = static_cast<unsigned>(least);
  __syncthreads();
  for (int w = 0; w < kMedianThreads / kWarp; ++w) above = min(above, room[w]);
  const float low = __uint_as_float(lower), high = repeated || used % 2 ? low : __uint_as_float(above);
  return used ? 0.5f * (low + high) : 0.0f;
}

}  // namespace ggslam::cuda
