// SPDX-License-Identifier: Apache-2.0
// Sums many values over the lanes of a warp at once.
//
// Reducing each value by itself takes five shuffles per value. Here the lanes split the values instead: in each step two
// lanes meet, one keeps the first half of the values, the other the second half, and each hands over what it does not
// keep. 32 values take 31 shuffles, and the sums end up spread over the lanes, ready to be added to memory side by side.
#pragma once
#include "common/platform.cuh"

namespace ggslam::cuda {

// One step: values i and i + kHalf, of which kCount are in use, become value i of the lanes without / with bit kHalf.
template <int kCount, int kHalf>
__device__ inline void split_values(float* values, int lane) {
  const bool upper = (lane & kHalf) != 0;
#pragma unroll
  for (int i = 0; i < kHalf && i < kCount; ++i) {
    if (i + kHalf < kCount) {
      const float keep = upper ? values[i + kHalf] : values[i], give = upper ? values[i] : values[i + kHalf];
      values[i] = keep + __shfl_xor_sync(kAllLanes, give, kHalf);
    } else {
      values[i] += __shfl_xor_sync(kAllLanes, values[i], kHalf);  // the other half is not in use
    }
  }
}

// Returns, in lane i < kCount, the sum of values[i] over the warp; the other lanes' results mean nothing. Overwrites
// `values`.
template <int kCount>
__device__ inline float sum_over_warp(float (&values)[kCount], int lane) {
  static_assert(kCount <= 32, "one value per lane");
  if constexpr (kCount > 16) split_values<kCount, 16>(values, lane);
  split_values<(kCount < 16 ? kCount : 16), 8>(values, lane);
  split_values<(kCount < 8 ? kCount : 8), 4>(values, lane);
  split_values<(kCount < 4 ? kCount : 4), 2>(values, lane);
  split_values<(kCount < 2 ? kCount : 2), 1>(values, lane);
  if constexpr (kCount <= 16) values[0] += __shfl_xor_sync(kAllLanes, values[0], 16);
  return values[0];
}

}  // namespace ggslam::cuda
