// SPDX-License-Identifier: Apache-2.0
// Tells the host how much room renderings needed, without a wait. Compiled in api.cu.
#pragma once
#include "common/platform.cuh"

namespace ggslam::cuda {

// Sends the two numbers of a rendering's totals, on the device, to a counter, as a projection does.
void count_pairs(void* counter, const std::int64_t* totals, cudaStream_t stream);

}  // namespace ggslam::cuda
