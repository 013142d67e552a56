// SPDX-License-Identifier: Apache-2.0
// Of the matched points of an alignment: how many they are, and the medians of their squared distances and depths.
#pragma once
#include "common/block_median.cuh"
#include "abi/cuda/tracking.hpp"

namespace ggslam::cuda {

// The first block tells of distances, the second of depths.
__global__ void __launch_bounds__(kMedianThreads) residual_medians_kernel(AlignJob job) {
  GGSLAM_SHARED unsigned room[kMedianThreads / kWarp];
  const int count = job.points.header->count;
  const bool of_depths = blockIdx.x == 1;
  const auto bits_of = [&](int i) {
    const std::uint32_t squared = __float_as_uint(job.squared_distance[i]);
    if (squared >= 0x7f800000u) return kLeftOut;
    return of_depths ? __float_as_uint(job.points.points[3 * static_cast<std::int64_t>(i) + 2]) : squared;
  };
  unsigned found = 0;
  for (int i = static_cast<int>(threadIdx.x); i < count; i += kMedianThreads) found += bits_of(i) != kLeftOut;
  const int matched = static_cast<int>(sum_over_block<kMedianThreads>(found, room));
  const float median = block_median(count, matched, bits_of, room);
  if (threadIdx.x != 0) return;
  job.results[of_depths ? kMatchedDepth : kMedianSquared] = median;
  if (!of_depths) job.results[kMatched] = matched;
}

}  // namespace ggslam::cuda
