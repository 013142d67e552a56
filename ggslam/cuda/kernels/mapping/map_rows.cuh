// SPDX-License-Identifier: Apache-2.0
// Rows of a map that go: which, and how the others close up. Rows move to the front only, so that a part of them at a time
// goes by way of a little memory and back.
#pragma once
#include "abi/cuda/growth.hpp"
#include "common/carver.cuh"
#include "common/sorting.cuh"

namespace ggslam::cuda {

constexpr int kRowThreads = 256;
constexpr std::int64_t kRowsAtOnce = 1 << 16;
constexpr std::int64_t kRowBlocks = 1024;  // at most

struct RowsWorkspace {
  std::uint32_t* chosen;  // [count], 1 where a row stays
  std::uint32_t* sums;    // [count], running sum of `chosen`
  std::uint32_t* order;   // [count], numbers of the rows that stay, one after the other
  std::uint32_t* moving;  // words of kRowsAtOnce rows, array by array
  void* scratch;
  std::size_t scratch_bytes, bytes;
};

inline RowsWorkspace rows_workspace(void* block, const RowsJob& job) {
  std::int64_t words = 0;
  for (int k = 0; k < job.array_count; ++k) words += job.arrays[k].words;
  Carver carver(block);
  RowsWorkspace w;
  w.chosen = carver.take<std::uint32_t>(job.count);
  w.sums = carver.take<std::uint32_t>(job.count);
  w.order = carver.take<std::uint32_t>(job.count);
  w.moving = carver.take<std::uint32_t>(words * (job.count < kRowsAtOnce ? job.count : kRowsAtOnce));
  w.scratch_bytes = sorting_bytes(job.count);
  w.scratch = carver.take<char>(static_cast<std::int64_t>(w.scratch_bytes));
  w.bytes = carver.used();
  return w;
}

__device__ inline std::int64_t row_thread() { return static_cast<std::int64_t>(blockIdx.x) * kRowThreads + threadIdx.x; }

// A thread for each Gaussian. What is no number is of no use.
__global__ void __launch_bounds__(kRowThreads) prune_kernel(PruneJob job) {
  const std::int64_t i = row_thread();
  if (i >= job.count) return;
  bool stays = job.opacity_logits[i] > job.least_logit;
  for (int k = 0; k < 3; ++k) {
    stays = stays && job.log_scales[3 * i + k] < job.largest_log_scale;
    stays = stays && fabsf(job.means[3 * i + k]) < INFINITY;
  }
  job.stays[i] = stays ? 1 : 0;
}

// A thread for each row.
__global__ void __launch_bounds__(kRowThreads) mark_rows_kernel(RowsJob job, RowsWorkspace w) {
  const std::int64_t i = row_thread();
  if (i < job.count) w.chosen[i] = job.stays[i] != 0 ? 1 : 0;
}

// A thread for each row.
__global__ void __launch_bounds__(kRowThreads) number_rows_kernel(RowsJob job, RowsWorkspace w) {
  const std::int64_t i = row_thread();
  if (i >= job.count) return;
  if (w.chosen[i] != 0) w.order[w.sums[i] - 1] = static_cast<std::uint32_t>(i);
  if (i == job.count - 1) *job.kept = static_cast<std::int32_t>(w.sums[i]);
}

// Rows that become [begin, begin + count), to the memory between.
__global__ void __launch_bounds__(kRowThreads)
gather_rows_kernel(RowsJob job, RowsWorkspace w, std::int64_t begin, std::int64_t count) {
  const std::int64_t threads = static_cast<std::int64_t>(gridDim.x) * kRowThreads;
  std::uint32_t* out = w.moving;
  for (int k = 0; k < job.array_count; ++k) {
    const RowArray array = job.arrays[k];
    for (std::int64_t i = row_thread(); i < count * array.words; i += threads)
      out[i] = array.rows[w.order[begin + i / array.words] * array.words + i % array.words];
    out += count * array.words;
  }
}

// And back.
__global__ void __launch_bounds__(kRowThreads)
put_rows_kernel(RowsJob job, RowsWorkspace w, std::int64_t begin, std::int64_t count) {
  const std::int64_t threads = static_cast<std::int64_t>(gridDim.x) * kRowThreads;
  const std::uint32_t* in = w.moving;
  for (int k = 0; k < job.array_count; ++k) {
    const RowArray array = job.arrays[k];
    for (std::int64_t i = row_thread(); i < count * array.words; i += threads) array.rows[begin * array.words + i] = in[i];
    in += count * array.words;
  }
}

}  // namespace ggslam::cuda
