// SPDX-License-Identifier: Apache-2.0
// What is optimised of a keyframe besides the map, its pose and its exposure, and one step of Adam (Kingma and Ba 2015)
// on them. The arithmetic is that of PoseAdam (ggslam/mapping/keyframe.py), ExposureAdam (ggslam/mapping/exposure.py) and
// se3_exp (ggslam/scene/poses.py).
#pragma once
#include "common/platform.cuh"
#include "abi/cuda/mapping.hpp"
#include "mapping/image_loss.cuh"

namespace ggslam::cuda {

constexpr double kMomentDecay1 = 0.9, kMomentDecay2 = 0.99;
constexpr double kPoseEpsilon = 1e-15, kExposureEpsilon = 1e-12;  // beside the root of the second moment
constexpr double kLargestFinite = 1.7976931348623157e308;

// Twist (v, w), translation first, to the first three rows of a rigid transform.
__device__ inline void exponential(const double v[3], const double w[3], double rows[3][4]) {
  const double angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2], angle = sqrt(angle2);
  double a = 1.0 - angle2 / 6.0, b = 0.5 - angle2 / 24.0, c = 1.0 / 6.0 - angle2 / 120.0;
  if (angle >= 1e-6) {
    a = sin(angle) / angle;
    b = (1.0 - cos(angle)) / angle2;
    c = (angle - sin(angle)) / (angle2 * angle);
  }
  const double W[3][3] = {{0.0, -w[2], w[1]}, {w[2], 0.0, -w[0]}, {-w[1], w[0], 0.0}};
  for (int i = 0; i < 3; ++i) {
    rows[i][3] = 0.0;
    for (int j = 0; j < 3; ++j) {
      const double one = i == j ? 1.0 : 0.0, square = w[i] * w[j] - one * angle2;  // W W = w w^T - |w|^2 I
      rows[i][j] = one + (a * W[i][j] + b * square);
      rows[i][3] += (one + b * W[i][j] + c * square) * v[j];
    }
  }
}

// What a parameter moves by at a rate of 1, against the gradient.
__device__ inline double adam_direction(AdamMoments& moments, int k, std::int64_t step, double gradient,
                                        double epsilon) {
  moments.first[k] += (1.0 - kMomentDecay1) * (gradient - moments.first[k]);
  moments.second[k] += (1.0 - kMomentDecay2) * (gradient * gradient - moments.second[k]);
  const double u = static_cast<double>(step);
  const double first = moments.first[k] / (1.0 - pow(kMomentDecay1, u));
  const double second = moments.second[k] / (1.0 - pow(kMomentDecay2, u));
  return -first / (sqrt(second) + epsilon);
}

// Lane k < 6 stands for component k of the gradient. All lanes of the warp must call this.
__device__ inline void step_pose(KeyframeState& state, int lane, double gradient, double rate) {
  const std::int64_t step = state.pose_steps + 1;
  double mine = 0.0, twist[6], rows[3][4];
  if (lane < 6) mine = rate * adam_direction(state.pose_moments, lane, step, gradient, kPoseEpsilon);
  for (int k = 0; k < 6; ++k) twist[k] = __shfl_sync(kAllLanes, mine, k);
  exponential(twist, twist + 3, rows);
  // Lane 4 i + j works out the new pose's row i, column j.
  const int row = lane / 4 % 3, column = lane % 4;
  double moved = 0.0;
#pragma unroll
  for (int k = 0; k < 4; ++k) {
    const double entry = row == 0 ? rows[0][k] : row == 1 ? rows[1][k] : rows[2][k];
    moved += entry * state.pose[4 * k + column];
  }
  __syncwarp();  // all have read
  if (lane < 12) state.pose[lane] = moved, state.pose_copy[lane] = static_cast<float>(moved);
  if (lane == 0) state.pose_steps = step;
}

// One component of the exposure.
__device__ inline void step_exposure(KeyframeState& state, int k, std::int64_t step, double gradient,
                                     const KeyframeStepJob& job) {
  const double pulled = gradient + job.exposure_regularization * (state.exposure[k] - state.exposure_anchor[k]);
  const double direction = adam_direction(state.exposure_moments, k, step, pulled, kExposureEpsilon);
  state.exposure[k] += job.exposure_rate * direction;
  state.exposure_copy[k] = static_cast<float>(state.exposure[k]);
}

__device__ inline void add_to_totals(LossTotals& totals, const double* results) {
  totals.total += results[kTotal];
  totals.color += results[kColor];
  totals.ssim += results[kSsim];
  totals.depth += results[kDepth];
  totals.last_psnr = results[kPsnr];
  totals.iterations += 1.0;
}

// One warp. Gradients that are not finite are passed over, those of the pose and of the exposure each as a whole.
__global__ void keyframe_step_kernel(KeyframeStepJob job) {
  constexpr unsigned kPoseLanes = 0x3f, kExposureLanes = kPoseLanes << 6;
  if (job.skipped != nullptr && *job.skipped != 0) return;
  if (job.choice != nullptr) {
    job.state = job.choice->state;
    job.pose_rate = job.choice->pose_rate;
    job.step_exposure = job.choice->step_exposure;
  }
  const int lane = static_cast<int>(threadIdx.x);
  KeyframeState& state = *job.state;
  double gradient = 0.0;
  if (lane < 6) gradient = job.twist[lane];
  if (lane >= 6 && lane < 12) gradient = job.results[kExposureGradient + lane - 6];
  const unsigned finite = __ballot_sync(kAllLanes, fabs(gradient) <= kLargestFinite);
  if (lane == 0) add_to_totals(*job.totals, job.results);
  if (job.step_exposure != 0 && (finite & kExposureLanes) == kExposureLanes) {
    const std::int64_t step = state.exposure_steps + 1;
    __syncwarp();  // all have read
    if (lane >= 6 && lane < 12) step_exposure(state, lane - 6, step, gradient, job);
    if (lane == 0) state.exposure_steps = step;
  }
  if (job.pose_rate > 0.0 && (finite & kPoseLanes) == kPoseLanes) step_pose(state, lane, gradient, job.pose_rate);
}

// One warp.
__global__ void keyframe_write_kernel(KeyframeWriteJob job) {
  const int lane = static_cast<int>(threadIdx.x);
  KeyframeState& state = *job.state;
  if (lane < 16) state.pose[lane] = job.pose[lane];
  if (lane < 12) state.pose_copy[lane] = static_cast<float>(job.pose[lane]);
  if (job.is_new == 0) return;
  if (lane < 6) {
    state.exposure[lane] = job.exposure[lane];
    state.exposure_copy[lane] = static_cast<float>(job.exposure[lane]);
    state.exposure_anchor[lane] = lane % 2 == 0 ? 1.0 : 0.0;
    for (AdamMoments* moments : {&state.pose_moments, &state.exposure_moments})
      moments->first[lane] = moments->second[lane] = 0.0;
  }
  if (lane == 0) state.pose_steps = state.exposure_steps = 0;
}

}  // namespace ggslam::cuda
