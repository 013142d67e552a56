// SPDX-License-Identifier: Apache-2.0
// What differs from step to step lies on a desk in device memory, from which the kernels of a step read it: all steps are
// started with the same arguments, so that one of them, recorded as a graph, stands for all.
#pragma once
#include "abi/cuda/training.hpp"
#include "rendering/workspace.cuh"

namespace ggslam::cuda {

constexpr int kBoundThreads = 256;

struct TrainingDesk {
  TrainingStep step;       // the one that is made
  float pose[12];          // that it renders, as it was when the step began
  float exposure[6];       // of its keyframe, likewise
  std::int64_t totals[2];  // as Totals; the pairs are the most of any step of the call so far
  std::int32_t next;       // of the waiting ones
  TrainingStep waiting[kMostWaitingSteps];
};

// Steps as an argument of a kernel: no memory of the host is read later.
struct StepBatch {
  TrainingStep steps[kMostWaitingSteps];
  std::int32_t count;
  std::int32_t first;  // 1: of a call
};
static_assert(sizeof(StepBatch) <= 4096 - 64, "arguments of a kernel take 4 KiB at most");
static_assert(sizeof(TrainingStep) % sizeof(std::uint32_t) == 0, "steps are copied by words");

// Copies a structure by the lanes of a warp.
template <class T>
__device__ inline void copy_words(T& to, const T& from, int lane) {
  auto* out = reinterpret_cast<std::uint32_t*>(&to);
  const auto* in = reinterpret_cast<const std::uint32_t*>(&from);
  for (int k = lane; k < static_cast<int>(sizeof(T) / sizeof(std::uint32_t)); k += kWarp) out[k] = in[k];
}

// One warp.
__global__ void lay_down_steps_kernel(StepBatch batch, TrainingDesk* desk) {
  const int lane = static_cast<int>(threadIdx.x);
  for (int i = 0; i < batch.count; ++i) copy_words(desk->waiting[i], batch.steps[i], lane);
  if (lane != 0) return;
  desk->next = 0;
  if (batch.first != 0) desk->totals[0] = desk->totals[1] = 0;
}

// Number `i` of the first three rows of a frame's T_camera_world, row by row, that hangs on a keyframe.
__device__ inline float hanging_pose(const double* T_camera_keyframe, const KeyframeState& keyframe, int i) {
  double sum = 0.0;
  for (int k = 0; k < 4; ++k) sum += T_camera_keyframe[i / 4 * 4 + k] * keyframe.pose[4 * k + i % 4];
  return static_cast<float>(sum);
}

// One warp.
__global__ void begin_step_kernel(TrainingDesk* desk) {
  const int lane = static_cast<int>(threadIdx.x), number = desk->next;
  const TrainingStep& mine = desk->waiting[number];
  copy_words(desk->step, mine, lane);
  const KeyframeState& state = *mine.keyframe.state;
  if (lane < 12)
    desk->pose[lane] = mine.T_camera_keyframe == nullptr ? state.pose_copy[lane]
                                                         : hanging_pose(mine.T_camera_keyframe, state, lane);
  if (lane < 6) desk->exposure[lane] = state.exposure_copy[lane];
  __syncwarp();  // all have read which one it is
  if (lane == 0) desk->next = number + 1;
}

// Brings `count` values to `most` at most; what is no number stays.
__global__ void __launch_bounds__(kBoundThreads) bound_sizes_kernel(float* values, std::int64_t count, float most) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kBoundThreads + threadIdx.x;
  if (i < count && values[i] > most) values[i] = most;
}

// Brings `count` values between two others.
__global__ void __launch_bounds__(kBoundThreads)
bound_colors_kernel(float* values, std::int64_t count, float least, float most) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kBoundThreads + threadIdx.x;
  if (i >= count) return;
  if (values[i] < least) values[i] = least;
  if (values[i] > most) values[i] = most;
}

}  // namespace ggslam::cuda
