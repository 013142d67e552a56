// SPDX-License-Identifier: Apache-2.0
// Poses in double, how a twist moves them, and the equations that such a twist solves: by one thread.
#pragma once
#include "common/platform.cuh"

namespace ggslam::cuda {

constexpr double kPi = 3.14159265358979323846;

struct RigidPose {
  double r[9], t[3];
};

// A pose as points are turned by it.
struct FloatPose {
  float rotation[9], translation[3];
};

__device__ inline void rotate(const float (&r)[9], const float* v, float (&out)[3]) {
#pragma unroll
  for (int i = 0; i < 3; ++i) out[i] = r[3 * i] * v[0] + r[3 * i + 1] * v[1] + r[3 * i + 2] * v[2];
}

__device__ inline void set_float_pose(const double* rotation, const double* translation, FloatPose& pose) {
#pragma unroll
  for (int i = 0; i < 9; ++i) pose.rotation[i] = static_cast<float>(rotation[i]);
#pragma unroll
  for (int i = 0; i < 3; ++i) pose.translation[i] = static_cast<float>(translation[i]);
}

// exp of the twist (v, w) about the camera centre: the centre moves by v, the axes turn by exp(w).
template <int kSize>
__device__ inline RigidPose moved(const RigidPose& pose, const double (&twist)[kSize]) {
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

// Solves (H + damping diag(H) + least) x = b for the first n unknowns by Cholesky, the others being 0; false if H is not
// positive. Unknowns left out become equations x = 0, so that all indices are known to the compiler. Of the factor's
// diagonal the reciprocals are kept: nothing is divided.
template <int kSize>
__device__ inline bool solve(const double (&h)[kSize][kSize], const double (&b)[kSize], double damping, double least, int n,
                             double (&x)[kSize]) {
  double l[kSize][kSize], reciprocal[kSize];
  bool positive = true;
#pragma unroll
  for (int j = 0; j < kSize; ++j)
#pragma unroll
    for (int i = j; i < kSize; ++i) {
      double sum = i < n ? h[i][j] : (i == j ? 1.0 : 0.0);
      if (i == j) sum += damping * sum + least;
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
  for (int i = 0; i < kSize; ++i) {
    x[i] = i < n ? b[i] : 0.0;
#pragma unroll
    for (int k = 0; k < i; ++k) x[i] -= l[i][k] * x[k];
    x[i] *= reciprocal[i];
  }
#pragma unroll
  for (int i = kSize - 1; i >= 0; --i) {
#pragma unroll
    for (int k = i + 1; k < kSize; ++k) x[i] -= l[k][i] * x[k];
    x[i] *= reciprocal[i];
  }
  return positive;
}

}  // namespace ggslam::cuda
