// SPDX-License-Identifier: Apache-2.0
// What kernels/sorting.cu does by CUB.
#include <numeric>
#include <vector>

#include "common/sorting.cuh"

namespace ggslam::cuda {

std::size_t sorting_bytes(std::int64_t) { return 1; }

namespace {

void sort(const std::uint32_t* keys, std::uint32_t* sorted_keys, const std::uint32_t* values,
          std::uint32_t* sorted_values, std::int64_t count, int bits) {
  const std::uint32_t mask = bits == 32 ? ~0u : (1u << bits) - 1;
  std::vector<std::int64_t> order(static_cast<std::size_t>(count));
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(),
                   [&](std::int64_t a, std::int64_t b) { return (keys[a] & mask) < (keys[b] & mask); });
  for (std::int64_t i = 0; i < count; ++i) {
    sorted_keys[i] = keys[order[static_cast<std::size_t>(i)]];
    sorted_values[i] = values[order[static_cast<std::size_t>(i)]];
  }
}

template <class Number>
cudaError_t sum(const Number* numbers, Number* sums, std::int64_t count, cudaStream_t stream) {
  emulation::run_or_record(stream, reinterpret_cast<const void*>(&sum<Number>),
                           [=] { std::partial_sum(numbers, numbers + count, sums); });
  return cudaSuccess;
}

}  // namespace

cudaError_t sort_pairs(void*, std::size_t, const std::uint32_t* keys, std::uint32_t* sorted_keys, const std::uint32_t* values,
                       std::uint32_t* sorted_values, std::int64_t count, int bits, cudaStream_t stream) {
  emulation::run_or_record(stream, reinterpret_cast<const void*>(&sort_pairs),
                           [=] { sort(keys, sorted_keys, values, sorted_values, count, bits); });
  return cudaSuccess;
}

cudaError_t running_sum(void*, std::size_t, const std::uint32_t* numbers, std::uint32_t* sums, std::int64_t count,
                        cudaStream_t stream) {
  return sum(numbers, sums, count, stream);
}

std::size_t long_sum_bytes(std::int64_t) { return 1; }

cudaError_t long_running_sum(void*, std::size_t, const std::int64_t* numbers, std::int64_t* sums, std::int64_t count,
                             cudaStream_t stream) {
  return sum(numbers, sums, count, stream);
}

}  // namespace ggslam::cuda
