// SPDX-License-Identifier: Apache-2.0
// The first values of what a keyframe brings to the map: rows, votes, identity vectors, classes; and labels by votes.
#pragma once
#include "abi/cuda/growth.hpp"
#include "common/platform.cuh"

namespace ggslam::cuda {

constexpr int kGrowthThreads = 256;
constexpr float kLeastLength = 1e-12f;  // of a class's weights

__device__ inline std::int64_t growth_thread() {
  return static_cast<std::int64_t>(blockIdx.x) * kGrowthThreads + threadIdx.x;
}

// A thread for each word of the longest array.
__global__ void __launch_bounds__(kGrowthThreads) fill_words_kernel(FillJob job) {
  const std::int64_t i = growth_thread();
  for (int k = 0; k < job.count; ++k)
    if (i < job.fills[k].count) job.fills[k].words[i] = job.fills[k].value;
}

// A thread for each Gaussian.
__global__ void __launch_bounds__(kGrowthThreads) vote_labels_kernel(VoteLabelJob job) {
  const std::int64_t i = growth_thread();
  if (i >= job.count) return;
  const float* weights = job.vote_weights + i * job.slots;
  int best = 0;
  for (int k = 1; k < job.slots; ++k)
    if (weights[k] > weights[best]) best = k;
  job.labels[i] = weights[best] > 0.0f ? job.vote_ids[i * job.slots + best] : 0;
}

// A thread for each new Gaussian.
__global__ void __launch_bounds__(kGrowthThreads) birth_labels_kernel(BirthLabelJob job) {
  const std::int64_t i = growth_thread();
  if (i >= job.count) return;
  const std::int32_t under = job.mask != nullptr ? job.mask[job.pixels[i]] : 0;
  const std::int32_t id = job.alias[job.labels != nullptr ? job.labels[i] : under];
  job.vote_ids[i * job.slots] = id;
  job.vote_weights[i * job.slots] = id > 0 ? job.vote : 0.0f;
  if (job.features == nullptr) return;
  const std::int32_t number = job.class_of[id];
  const float* row = job.class_rows + static_cast<std::int64_t>(max(number, 0)) * (job.channels + 1);
  float squares = 0.0f;
  for (int k = 0; k < job.channels; ++k) squares += row[k] * row[k];
  const float length = fmaxf(sqrtf(squares), kLeastLength);
  for (int k = 0; k < job.channels; ++k)
    job.features[i * job.channels + k] = number < 0 ? 0.0f : job.code_length * row[k] / length;
}

// A thread for each number of the new rows.
__global__ void __launch_bounds__(kGrowthThreads) new_classes_kernel(NewClassJob job) {
  const int i = static_cast<int>(growth_thread()), wide = job.channels + 1;
  if (i >= job.count * wide) return;
  const int k = i / wide, column = i % wide, number = job.first + k;
  job.rows[static_cast<std::int64_t>(number) * wide + column] =
      column < job.channels ? job.weights[k * job.channels + column] : 0.0f;
  if (column > 0) return;
  job.ids[number] = job.new_ids[k];
  job.class_of[job.new_ids[k]] = number;
}

}  // namespace ggslam::cuda
