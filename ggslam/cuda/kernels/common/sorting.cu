// SPDX-License-Identifier: Apache-2.0
// Sorting and summing by CUB, which comes with the CUDA toolkit.
#include <algorithm>
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>

#include "common/sorting.cuh"

namespace ggslam::cuda {

std::size_t sorting_bytes(std::int64_t count) {
  const std::uint32_t* in = nullptr;
  std::uint32_t* out = nullptr;
  const int n = static_cast<int>(count);
  std::size_t sort = 0, sum = 0;
  cub::DeviceRadixSort::SortPairs(nullptr, sort, in, out, in, out, n, 0, 32);
  cub::DeviceScan::InclusiveSum(nullptr, sum, in, out, n);
  return std::max(sort, sum);
}

cudaError_t sort_pairs(void* scratch, std::size_t scratch_bytes, const std::uint32_t* keys, std::uint32_t* sorted_keys,
                       const std::uint32_t* values, std::uint32_t* sorted_values, std::int64_t count, int bits,
                       cudaStream_t stream) {
  return cub::DeviceRadixSort::SortPairs(scratch, scratch_bytes, keys, sorted_keys, values, sorted_values,
                                         static_cast<int>(count), 0, bits, stream);
}

cudaError_t running_sum(void* scratch, std::size_t scratch_bytes, const std::uint32_t* numbers, std::uint32_t* sums,
                        std::int64_t count, cudaStream_t stream) {
  return cub::DeviceScan::InclusiveSum(scratch, scratch_bytes, numbers, sums, static_cast<int>(count), stream);
}

std::size_t long_sum_bytes(std::int64_t count) {
  const std::int64_t* in = nullptr;
  std::int64_t* out = nullptr;
  std::size_t bytes = 0;
  cub::DeviceScan::InclusiveSum(nullptr, bytes, in, out, static_cast<int>(count));
  return bytes;
}

cudaError_t long_running_sum(void* scratch, std::size_t scratch_bytes, const std::int64_t* numbers, std::int64_t* sums,
                             std::int64_t count, cudaStream_t stream) {
  return cub::DeviceScan::InclusiveSum(scratch, scratch_bytes, numbers, sums, static_cast<int>(count), stream);
}

}  // namespace ggslam::cuda
