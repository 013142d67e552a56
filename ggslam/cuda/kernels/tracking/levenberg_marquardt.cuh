// SPDX-License-Identifier: Apache-2.0
// Levenberg-Marquardt between two linearisations, in double, by one thread: the rules of native/src/tracking/gicp_api.cpp. What
// that file does in loops is spread over launches here, so the place in the loops is part of the state.
#pragma once
#include "common/carver.cuh"
#include "tracking/photometric_terms.cuh"
#include "tracking/rigid_motion.cuh"

namespace ggslam::cuda {

constexpr int kUnknowns = 8;  // twist, gain, bias
constexpr double kAcceptedRise = 1.05;

struct NormalEquations {
  double h[kUnknowns][kUnknowns];
  double b[kUnknowns];
  double cost;  // per unit of weight
  double matches, grey_count;
};

enum AlignPhase { kCoarsePhase, kFinePhase, kReportPhase };

struct AlignState {
  RigidPose pose, candidate;
  double gain, bias, candidate_gain, candidate_bias, damping;
  NormalEquations current;
  std::int32_t phase;
  std::int32_t evaluations;  // at this level
  std::int32_t fresh;        // nothing was matched at this level yet
  std::int32_t converged, coarse_iterations, fine_iterations;
};

__device__ inline bool is_small(const AlignSettings& s, const double (&x)[kUnknowns], double factor) {
  const double v = sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]);
  const double w = sqrt(x[3] * x[3] + x[4] * x[4] + x[5] * x[5]);
  return v < factor * s.translation_tolerance && w < factor * s.rotation_tolerance;
}

__device__ inline void start_level(AlignState& s, AlignPhase phase) {
  s.phase = phase;
  s.candidate = s.pose, s.candidate_gain = s.gain, s.candidate_bias = s.bias;
  s.damping = 1e-6;
  s.evaluations = s.converged = 0;
  s.fresh = 1;
}

__device__ inline void start_alignment(AlignState& s, const AlignJob& job) {
#pragma unroll
  for (int i = 0; i < 9; ++i) s.pose.r[i] = job.guess[i];
#pragma unroll
  for (int i = 0; i < 3; ++i) s.pose.t[i] = job.guess[9 + i];
  s.gain = 1, s.bias = 0;
  s.coarse_iterations = s.fine_iterations = 0;
  start_level(s, job.settings.coarse_iterations > 0 ? kCoarsePhase : kFinePhase);
}

__device__ inline void accept(AlignState& s) {
  s.pose = s.candidate, s.gain = s.candidate_gain, s.bias = s.candidate_bias;
}

__device__ inline void finish_level(AlignState& s) {
  if (s.phase == kCoarsePhase) {
    s.coarse_iterations = s.evaluations;
    start_level(s, kFinePhase);
    return;
  }
  s.fine_iterations = s.evaluations;
  orthonormalize(s.pose.r);
  s.phase = kReportPhase;
}

// Takes the step that the current normal equations ask for, as a candidate; false if the level ends here.
__device__ inline bool propose(AlignState& s, const AlignSettings& settings, bool photometric) {
  double x[kUnknowns];
  const int unknowns = photometric && s.current.grey_count > 50 ? 8 : 6;
  if (s.current.matches < settings.min_matches || !solve(s.current.h, s.current.b, s.damping, 1e-12, unknowns, x)) return false;
  s.candidate = moved(s.pose, x);
  s.candidate_gain = s.gain + x[6], s.candidate_bias = s.bias + x[7];
  if (!is_small(settings, x, s.phase == kCoarsePhase ? 10 : 1)) return true;
  accept(s);
  s.converged = 1;
  return false;
}

// Goes on after the linearisation `next` at the candidate.
__device__ inline void advance(AlignState& s, const NormalEquations& next, const AlignSettings& settings,
                               bool photometric) {
  ++s.evaluations;
  s.fresh = 0;
  if (s.evaluations == 1) {
    s.current = next;
  } else if (next.cost <= s.current.cost * kAcceptedRise && next.matches >= settings.min_matches) {
    // Matches change from step to step, which lets the cost rise a little on the way down; see the core.
    accept(s);
    s.current = next;
    s.damping = fmax(s.damping * 0.1, 1e-9);
  } else if (s.damping > 1e3) {
    finish_level(s);
    return;
  } else {
    s.damping = fmax(s.damping * 100, 1e-3);
  }
  const int iterations = s.phase == kCoarsePhase ? settings.coarse_iterations : settings.fine_iterations;
  if (s.evaluations >= iterations || !propose(s, settings, photometric)) finish_level(s);
}

}  // namespace ggslam::cuda
