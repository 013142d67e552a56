// SPDX-License-Identifier: Apache-2.0
// Levenberg-Marquardt between two linearisations, in double, by one thread: the rules of native/src/tracking/gicp_api.cpp. What
// that file does in loops is spread over launches here, so the place in the loops is part of the state.
#pragma once
#include "common/carver.cuh"
#include "tracking/photometric_terms.cuh"

namespace ggslam::cuda {

constexpr int kUnknowns = 8;  // twist, gain, bias
constexpr double kAcceptedRise = 1.05, kPi = 3.14159265358979323846;

struct RigidPose {
  double r[9], t[3];
};

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

// exp of the twist (v, w) about the camera centre: the centre moves by v, the axes turn by exp(w).
__device__ inline RigidPose moved(const RigidPose& pose, const double (&twist)[kUnknowns]) {
  const double w[3] = {twist[3], twist[4], twist[5]};
  const double angle = sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
  const bool small = angle < 1e-6;
  const double turns = angle / kPi;  // sinpi and cospi do without the slow path that sin and cos have for large angles
  const double a = small ? 1 - angle * angle / 6 : sinpi(turns) / angle;
  const double b = small ? 0.5 - angle * angle / 24 : (1 - cospi(turns)) / (angle * angle);
  const double k[9] = {0, -w[2], w[1], w[2], 0, -w[0], -w[1], w[0], 0};
  double turn[9];
#pragma unroll
  for (int i = 0; i < 3; ++i)
#pragma unroll
    for (int j = 0; j < 3; ++j) {
      const double kk = k[3 * i] * k[j] + k[3 * i + 1] * k[3 + j] + k[3 * i + 2] * k[6 + j];
      turn[3 * i + j] = (i == j) + a * k[3 * i + j] + b * kk;
    }
  RigidPose out;
#pragma unroll
  for (int i = 0; i < 3; ++i) {
#pragma unroll
    for (int j = 0; j < 3; ++j)
      out.r[3 * i + j] = turn[3 * i] * pose.r[j] + turn[3 * i + 1] * pose.r[3 + j] + turn[3 * i + 2] * pose.r[6 + j];
    out.t[i] = pose.t[i] + twist[i];
  }
  return out;
}

__device__ inline void normalize_row(double* v) {
  const double f = 1 / sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
  v[0] *= f, v[1] *= f, v[2] *= f;
}

// Gram-Schmidt on the rows.
__device__ inline void orthonormalize(double (&r)[9]) {
  normalize_row(r);
  const double dot = r[0] * r[3] + r[1] * r[4] + r[2] * r[5];
#pragma unroll
  for (int i = 0; i < 3; ++i) r[3 + i] -= dot * r[i];
  normalize_row(r + 3);
  r[6] = r[1] * r[5] - r[2] * r[4], r[7] = r[2] * r[3] - r[0] * r[5], r[8] = r[0] * r[4] - r[1] * r[3];
}

// Solves (H + damping diag(H)) x = b for the first n unknowns (6 or 8) by Cholesky, the others being 0; false if H is not
// positive. Unknowns left out become equations x = 0, so that all indices are known to the compiler. Of the factor's
// diagonal the reciprocals are kept: nothing is divided.
__device__ inline bool solve(const NormalEquations& system, double damping, int n, double (&x)[kUnknowns]) {
  double l[kUnknowns][kUnknowns], reciprocal[kUnknowns];
  bool positive = true;
#pragma unroll
  for (int j = 0; j < kUnknowns; ++j)
#pragma unroll
    for (int i = j; i < kUnknowns; ++i) {
      double sum = i < n ? system.h[i][j] : (i == j ? 1.0 : 0.0);
      if (i == j) sum += damping * sum + 1e-12;
#pragma unroll
      for (int k = 0; k < j; ++k) sum -= l[i][k] * l[j][k];
      if (i == j) {
        positive = positive && sum > 0;
        reciprocal[j] = rsqrt(sum);
      } else {
        l[i][j] = sum * reciprocal[j];
      }
    }
#pragma unroll
  for (int i = 0; i < kUnknowns; ++i) {
    x[i] = i < n ? system.b[i] : 0.0;
#pragma unroll
    for (int k = 0; k < i; ++k) x[i] -= l[i][k] * x[k];
    x[i] *= reciprocal[i];
  }
#pragma unroll
  for (int i = kUnknowns - 1; i >= 0; --i) {
#pragma unroll
    for (int k = i + 1; k < kUnknowns; ++k) x[i] -= l[k][i] * x[k];
    x[i] *= reciprocal[i];
  }
  return positive;
}

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
  if (s.current.matches < settings.min_matches || !solve(s.current, s.damping, unknowns, x)) return false;
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
