// SPDX-License-Identifier: Apache-2.0
// Alignment of a scan's features to the local map, Levenberg-Marquardt with matchings in between, in one launch: features
// are so few that one block has them all, and waiting for others would take longer than they save. Which thread has which
// feature is fixed, and so is the order of all sums.
#pragma once
#include "common/warp_reduction.cuh"
#include "edges_planes/feature_terms.cuh"

namespace ggslam::cuda {

constexpr int kFeatureThreads = 512;
constexpr int kFeatureWarps = kFeatureThreads / kWarp;

struct FeatureState {
  RigidPose pose, candidate;
  RigidPose matched_at;
  double current[kFeatureSums];  // at `pose`
  double next[kFeatureSums];     // at the candidate
  double damping, step[6];
  std::int32_t rows, matchings, steps, steps_here, settled;
  std::int32_t goes_on, matches_again;  // another step, another matching follows
};

// Sums over the block in double, thread by thread, warp by warp. Starts and ends with a barrier.
template <int kCount>
__device__ inline void sum_features(float (&values)[kCount], double* sums, float (&room)[kFeatureWarps][kWarp]) {
  const int lane = static_cast<int>(threadIdx.x % kWarp), warp = static_cast<int>(threadIdx.x / kWarp);
  const float sum = sum_over_warp(values, lane);
  __syncthreads();
  room[warp][lane] = sum;
  __syncthreads();
  if (warp == 0 && lane < kCount) {
    double total = 0;
#pragma unroll
    for (int w = 0; w < kFeatureWarps; ++w) total += room[w][lane];
    sums[lane] = total;
  }
  __syncthreads();
}

__device__ inline void linearise(const FeatureAlignJob& job, const AlignedCounts& counts, const RigidPose& at, double* sums,
                                 float (&room)[kFeatureWarps][kWarp]) {
  FloatPose pose;
  set_float_pose(at.r, at.t, pose);
  float values[kFeatureSums] = {};
  for (int i = static_cast<int>(threadIdx.x); i < counts.planes + counts.edges; i += kFeatureThreads)
    feature_terms(job, counts, pose, i, values);
  sum_features(values, sums, room);
}

// Matches all features at the pose; how many residuals they have.
__device__ inline int match_features(const FeatureAlignJob& job, const AlignedCounts& counts, const RigidPose& at,
                                     bool is_last, unsigned (&room)[kFeatureWarps]) {
  FloatPose pose;
  set_float_pose(at.r, at.t, pose);
  unsigned rows = 0;
  for (int i = static_cast<int>(threadIdx.x); i < counts.planes + counts.edges; i += kFeatureThreads)
    rows += static_cast<unsigned>(match_feature(job, counts, pose, i, is_last));
  return static_cast<int>(sum_over_block<kFeatureThreads>(rows, room));
}

// Takes the step that the current normal equations ask for, as a candidate. By one thread.
__device__ inline void propose_step(FeatureState& s) {
  double h[6][6], b[6];
  int k = 0;
#pragma unroll
  for (int i = 0; i < 6; ++i) {
#pragma unroll
    for (int j = i; j < 6; ++j, ++k) h[i][j] = h[j][i] = s.current[kFeatureMatrix + k];
    b[i] = -s.current[kFeatureRight + i];
  }
  const bool solved = solve(h, b, s.damping, 1e-9, 6, s.step);  // what no residual sees stays as it is
#pragma unroll
  for (int i = 0; i < 6; ++i) s.step[i] = solved ? s.step[i] : 0;
  s.candidate = moved(s.pose, s.step);
}

// Judges the candidate, and says whether another step follows. By one thread.
__device__ inline void judge_step(const FeatureAlignLimits& limits, FeatureState& s) {
  ++s.steps, ++s.steps_here;
  if (s.next[kFeatureCost] <= s.current[kFeatureCost]) {
    s.pose = s.candidate;
    for (int k = 0; k < kFeatureSums; ++k) s.current[k] = s.next[k];
    s.damping *= 0.1;
  } else {
    s.damping *= 100;
  }
  const double shift = fmax(fmax(fabs(s.step[0]), fabs(s.step[1])), fabs(s.step[2]));
  const double turn = fmax(fmax(fabs(s.step[3]), fabs(s.step[4])), fabs(s.step[5]));
  const bool is_small = shift < limits.translation_tolerance && turn < limits.rotation_tolerance;
  s.goes_on = !is_small && s.steps_here < limits.inner_iterations;
  if (s.goes_on) propose_step(s);
}

// Whether a motion is so small that matching anew would change little.
__device__ inline bool is_settled(const FeatureAlignJob& job, const FeatureState& s) {
  double shift = 0, turn = 0;
  for (int a = 0; a < 3; ++a) shift += (s.pose.t[a] - s.matched_at.t[a]) * (s.pose.t[a] - s.matched_at.t[a]);
  for (int k = 0; k < 9; ++k) turn += (s.pose.r[k] - s.matched_at.r[k]) * (s.pose.r[k] - s.matched_at.r[k]);
  const double angle = 2 * asin(fmin(1.0, sqrt(turn / 8)));
  const double moved = sqrt(shift) + angle * static_cast<double>(job.scan.header->thin_median_distance);
  return moved < job.limits.rematch_distance;
}

// One matching with the steps after it. All threads take part; ends with a barrier.
__device__ inline void match_and_step(const FeatureAlignJob& job, const AlignedCounts& counts, FeatureState& s,
                                      float (&room)[kFeatureWarps][kWarp], unsigned (&count_room)[kFeatureWarps]) {
  const int rows = match_features(job, counts, s.pose, s.matchings + 1 == job.limits.outer_iterations, count_room);
  linearise(job, counts, s.pose, s.current, room);
  if (threadIdx.x == 0) {
    s.rows = rows, s.steps_here = 0, s.damping = 1e-6, s.matched_at = s.pose;
    ++s.matchings;
    s.goes_on = rows >= job.limits.min_matches;
    if (s.goes_on) propose_step(s);
    for (int k = 0; k < kFeatureSums && !s.goes_on; ++k) s.current[k] = 0;
  }
  __syncthreads();
  while (s.goes_on) {
    linearise(job, counts, s.candidate, s.next, room);
    if (threadIdx.x == 0) judge_step(job.limits, s);
    __syncthreads();
  }
  if (threadIdx.x == 0) {
    s.settled = rows >= job.limits.min_matches && is_settled(job, s);
    s.matches_again = rows >= job.limits.min_matches && !s.settled && s.matchings < job.limits.outer_iterations;
  }
  __syncthreads();
}

// T_world_map times the pose.
__device__ inline void write_world_pose(const double (&world)[12], const RigidPose& pose, double* out) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j)
      out[3 * i + j] = world[3 * i] * pose.r[j] + world[3 * i + 1] * pose.r[3 + j] + world[3 * i + 2] * pose.r[6 + j];
    out[9 + i] = world[3 * i] * pose.t[0] + world[3 * i + 1] * pose.t[1] + world[3 * i + 2] * pose.t[2] + world[9 + i];
  }
}

__device__ inline void write_feature_results(const FeatureAlignJob& job, const AlignedCounts& counts,
                                             const FeatureState& s, const double (&sums)[kFeatureReportSums]) {
  double* out = job.results;
  const FeatureHeader header = *job.scan.header;
  write_world_pose(job.T_world_map, s.pose, out + kFeatureWorldPose);
  for (int i = 0; i < 9; ++i) out[kFeaturePose + i] = s.pose.r[i];
  for (int i = 0; i < 3; ++i) out[kFeaturePose + 9 + i] = s.pose.t[i];
  for (int k = 0; k < 21; ++k) out[kFeatureInformation + k] = s.current[kFeatureMatrix + k];
  out[kFeatureRows] = s.rows, out[kFeatureSettled] = s.settled;
  out[kFeatureMatchings] = s.matchings, out[kFeatureSteps] = s.steps;
  out[kFeatureInliers] = sums[kSumInliers], out[kFeatureSquared] = sums[kSumSquared];
  const double weight = sums[kSumWeight], f = weight > 0 ? 1 / weight : 0;
  const float* origin = weight > 0 ? feature_of(job, counts, 0).point : nullptr;
  double squared = f * sums[kSumMoment2];
  out[kFeatureWeight] = weight;
  for (int a = 0; a < 3; ++a) {
    const double mean = f * sums[kSumMoment1 + a];
    squared -= mean * mean;
    out[kFeatureCentroid + a] = origin != nullptr ? mean + origin[a] : 0;
  }
  out[kFeatureRadius] = sqrt(fmax(squared, 0.0));
  out[kFeatureAligned] = counts.planes;
  out[kFeaturePlanes] = header.planes, out[kFeatureEdges] = header.edges;
  out[kFeatureMedianDepth] = header.median_depth, out[kFeatureMedianDistance] = header.median_distance;
}

__global__ void __launch_bounds__(kFeatureThreads) align_features_kernel(FeatureAlignJob job) {
  GGSLAM_SHARED FeatureState state;
  GGSLAM_SHARED float room[kFeatureWarps][kWarp];
  GGSLAM_SHARED unsigned count_room[kFeatureWarps];
  GGSLAM_SHARED double sums[kFeatureReportSums];
  const AlignedCounts counts = aligned_counts(job);
  if (threadIdx.x == 0) {
    for (int i = 0; i < 9; ++i) state.pose.r[i] = job.guess[i];
    for (int i = 0; i < 3; ++i) state.pose.t[i] = job.guess[9 + i];
    state.matchings = state.steps = 0;
  }
  __syncthreads();
  do match_and_step(job, counts, state, room, count_room);
  while (state.matches_again);
  FloatPose pose;
  set_float_pose(state.pose.r, state.pose.t, pose);
  float values[kFeatureReportSums] = {};
  for (int i = static_cast<int>(threadIdx.x); i < counts.planes + counts.edges; i += kFeatureThreads)
    feature_report(job, counts, pose, i, values);
  sum_features(values, sums, room);
  if (threadIdx.x == 0) write_feature_results(job, counts, state, sums);
}

}  // namespace ggslam::cuda
