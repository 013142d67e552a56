// SPDX-License-Identifier: Apache-2.0
// What identity learning needs beside the kernels of terms, classes and neighbours: products with the classifier, which
// has few columns, and what joins the parts of a step. Every sum has a fixed order.
#pragma once
#include "abi/cuda/sampled_identity.hpp"
#include "common/random.cuh"
#include "common/warp_reduction.cuh"

namespace ggslam::cuda {

constexpr int kIdentityThreads = 256, kIdentityWarps = kIdentityThreads / kWarp;
constexpr int kIdentityChannels = 16;  // length of an identity vector

__device__ inline std::int64_t identity_thread() {
  return static_cast<std::int64_t>(blockIdx.x) * kIdentityThreads + threadIdx.x;
}

// Labels of pixels, those of a whole replaced by its part's where the map shows the part.
__global__ void __launch_bounds__(kIdentityThreads)
take_parts_kernel(const std::int32_t* shown, const std::int32_t* whole_of, std::int32_t* labels, std::int32_t count) {
  const std::int64_t i = identity_thread();
  if (i < count && shown[i] > 0 && whole_of[shown[i]] == labels[i]) labels[i] = shown[i];
}

// logits [count, classes] of identity vectors, those of the named rows of `features`, or of all; a thread for each.
__global__ void __launch_bounds__(kIdentityThreads)
logits_kernel(const float* features, const std::int32_t* named, std::int64_t count, const float* rows, int classes,
              float* logits) {
  const std::int64_t i = identity_thread();
  if (i >= count * classes) return;
  const std::int64_t which = i / classes;
  const float* vector = features + (named != nullptr ? named[which] : which) * kIdentityChannels;
  const float* row = rows + (i - which * classes) * (kIdentityChannels + 1);
  float sum = row[kIdentityChannels];
#pragma unroll
  for (int k = 0; k < kIdentityChannels; ++k) sum += vector[k] * row[k];
  logits[i] = sum;
}

// Gradients by identity vectors [count, channels] from those by logits [count, classes]; a thread for each.
__global__ void __launch_bounds__(kIdentityThreads)
vector_gradients_kernel(const float* by_logits, std::int64_t count, const float* rows, int classes, float* out) {
  const std::int64_t i = identity_thread();
  if (i >= count * kIdentityChannels) return;
  const std::int64_t which = i / kIdentityChannels, channel = i - which * kIdentityChannels;
  const float* mine = by_logits + which * classes;
  float sum = 0.0f;
#pragma unroll 4
  for (int c = 0; c < classes; ++c) sum += mine[c] * rows[c * (kIdentityChannels + 1) + channel];
  out[i] = sum;
}

// Gradients by the classifier's rows [classes, channels + 1]; a block for each class.
__global__ void __launch_bounds__(kIdentityThreads)
row_gradients_kernel(const float* by_logits, const float* features, std::int32_t count, int classes, float* out) {
  constexpr int kColumns = kIdentityChannels + 1;
  GGSLAM_SHARED float of_warps[kIdentityWarps][kColumns];
  const int c = static_cast<int>(blockIdx.x), lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  float sums[kColumns] = {};
  for (int p = static_cast<int>(threadIdx.x); p < count; p += kIdentityThreads) {
    const float gradient = by_logits[static_cast<std::int64_t>(p) * classes + c];
    if (gradient == 0.0f) continue;
#pragma unroll
    for (int k = 0; k < kIdentityChannels; ++k) sums[k] += gradient * features[p * kIdentityChannels + k];
    sums[kIdentityChannels] += gradient;
  }
  const float sum = sum_over_warp(sums, lane);
  if (lane < kColumns) of_warps[warp][lane] = sum;
  __syncthreads();
  if (threadIdx.x >= kColumns) return;
  float total = 0.0f;
  for (int w = 0; w < kIdentityWarps; ++w) total += of_warps[w][threadIdx.x];
  out[c * kColumns + threadIdx.x] = total;
}

// Gaussians that are pulled to their neighbours.
__global__ void __launch_bounds__(kIdentityThreads)
draw_rows_kernel(std::uint64_t seed, std::uint64_t draw, std::int64_t gaussians, std::int32_t count, std::int64_t* rows) {
  const std::int64_t i = identity_thread();
  if (i >= count) return;
  const auto row = static_cast<std::int64_t>(random_number(seed, draw, i) * static_cast<double>(gaussians));
  rows[i] = row < gaussians ? row : gaussians - 1;
}

// Those and their neighbours [count * (1 + neighbours)], one list.
__global__ void __launch_bounds__(kIdentityThreads)
list_pulled_kernel(const std::int64_t* rows, const std::int64_t* neighbours, std::int32_t count, std::int32_t all,
                   std::int32_t* listed) {
  const std::int64_t i = identity_thread();
  if (i < all) listed[i] = static_cast<std::int32_t>(i < count ? rows[i] : neighbours[i - count]);
}

// Without a known pixel no term counts.
__global__ void __launch_bounds__(kIdentityThreads)
drop_terms_kernel(const std::int32_t* known, std::int32_t* counts, std::int64_t count) {
  const std::int64_t i = identity_thread();
  if (i < count && *known == 0) counts[i] = 0;
}

}  // namespace ggslam::cuda
