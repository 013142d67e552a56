// SPDX-License-Identifier: Apache-2.0
// Stable sorting and summing on the device. Compiled apart from the kernels, by sorting.cu.
#pragma once
#include "common/platform.cuh"

namespace ggslam::cuda {

// Bytes of scratch memory that sort_pairs and running_sum need for up to `count` numbers.
std::size_t sorting_bytes(std::int64_t count);

// Sorts values by the lowest `bits` bits of their keys; values of equal keys keep their order.
cudaError_t sort_pairs(void* scratch, std::size_t scratch_bytes, const std::uint32_t* keys, std::uint32_t* sorted_keys,
                       const std::uint32_t* values, std::uint32_t* sorted_values, std::int64_t count, int bits,
                       cudaStream_t stream);

// sums[i] = numbers[0] + ... + numbers[i].
cudaError_t running_sum(void* scratch, std::size_t scratch_bytes, const std::uint32_t* numbers, std::uint32_t* sums,
                        std::int64_t count, cudaStream_t stream);

// The same of longer numbers, with scratch memory of its own.
std::size_t long_sum_bytes(std::int64_t count);
cudaError_t long_running_sum(void* scratch, std::size_t scratch_bytes, const std::int64_t* numbers, std::int64_t* sums,
                             std::int64_t count, cudaStream_t stream);

}  // namespace ggslam::cuda
