// SPDX-License-Identifier: Apache-2.0
// Projection of a Gaussian by elliptical weighted averaging (Zwicker et al. 2001, "EWA splatting"): the image of the
// covariance Sigma = M M^T, M = R(q) diag(exp(log_scale)), under the linearised projection J W is
// V V^T + low_pass I with V = J W M. Forward and backward share these terms.
#pragma once
#include "rendering/rules.cuh"

namespace ggslam::cuda {

// The camera, with the limits of the slopes x/z and y/z that the Jacobian uses.
struct ViewConstants {
  float W[3][3], t[3];
  float fx, fy, cx, cy, near_plane, low_pass;
  float min_u, max_u, min_v, max_v;
};

inline ViewConstants view_constants(const CameraView& view) {
  ViewConstants c;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) c.W[i][j] = view.camera_world[4 * i + j];
    c.t[i] = view.camera_world[4 * i + 3];
  }
  c.fx = view.fx, c.fy = view.fy, c.cx = view.cx, c.cy = view.cy;
  c.near_plane = view.near_plane, c.low_pass = view.low_pass;
  // Image borders lie at -0.5 and width - 0.5: pixel centres are whole numbers.
  const float width = static_cast<float>(view.width), height = static_cast<float>(view.height);
  c.min_u = (-0.5f - view.cx - kFrustumMargin * width) / view.fx;
  c.max_u = (width - 0.5f - view.cx + kFrustumMargin * width) / view.fx;
  c.min_v = (-0.5f - view.cy - kFrustumMargin * height) / view.fy;
  c.max_v = (height - 0.5f - view.cy + kFrustumMargin * height) / view.fy;
  return c;
}

// What a kernel does first: takes the pose from where Rendering's pose leads, if that is not null.
__device__ inline void read_pose(const float* pose, ViewConstants& c) {
  if (pose == nullptr) return;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) c.W[i][j] = pose[4 * i + j];
    c.t[i] = pose[4 * i + 3];
  }
}

struct RawGaussian {
  float mean[3], quaternion[4], log_scale[3], opacity_logit;
};

__device__ inline RawGaussian load_gaussian(const GaussianArrays& arrays, std::int64_t row) {
  RawGaussian g;
  for (int k = 0; k < 3; ++k) g.mean[k] = arrays.means[3 * row + k];
  for (int k = 0; k < 4; ++k) g.quaternion[k] = arrays.quaternions[4 * row + k];
  for (int k = 0; k < 3; ++k) g.log_scale[k] = arrays.log_scales[3 * row + k];
  g.opacity_logit = arrays.opacity_logits[row];
  return g;
}

struct Projection {
  float position[3];      // mean in the camera frame
  float inverse_z, u, v;  // 1/z, x/z, y/z
  float clamped_u, clamped_v;
  float q[4], q_norm2, q_inverse_norm;
  float scale[3], M[3][3];
  float j00, j02, j11, j12;  // Jacobian of the projection; j01 = j10 = 0
  float JW[2][3], V[2][3];
  float cov_xx, cov_xy, cov_yy, inverse_determinant;
};

__device__ inline void project_position(const ViewConstants& c, const RawGaussian& g, Projection& p) {
  for (int i = 0; i < 3; ++i)
    p.position[i] = c.W[i][0] * g.mean[0] + (c.W[i][1] * g.mean[1] + (c.W[i][2] * g.mean[2] + c.t[i]));
  p.inverse_z = 1.0f / fmaxf(p.position[2], c.near_plane);
  p.u = p.position[0] * p.inverse_z;
  p.v = p.position[1] * p.inverse_z;
  p.clamped_u = fminf(fmaxf(p.u, c.min_u), c.max_u);
  p.clamped_v = fminf(fmaxf(p.v, c.min_v), c.max_v);
}

// p.M = R(q) diag(scale).
__device__ inline void shape_matrix(const RawGaussian& g, Projection& p) {
  const float* raw = g.quaternion;
  p.q_norm2 = raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2] + raw[3] * raw[3];
  p.q_inverse_norm = 1.0f / sqrtf(p.q_norm2);
  for (int k = 0; k < 4; ++k) p.q[k] = raw[k] * p.q_inverse_norm;
  const float w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
  const float R[3][3] = {
      {1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y - w * z), 2.0f * (x * z + w * y)},
      {2.0f * (x * y + w * z), 1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z - w * x)},
      {2.0f * (x * z - w * y), 2.0f * (y * z + w * x), 1.0f - 2.0f * (x * x + y * y)}};
  for (int j = 0; j < 3; ++j) {
    p.scale[j] = expf(g.log_scale[j]);
    for (int i = 0; i < 3; ++i) p.M[i][j] = R[i][j] * p.scale[j];
  }
}

__device__ inline void image_covariance(const ViewConstants& c, Projection& p) {
  p.j00 = c.fx * p.inverse_z, p.j02 = -c.fx * p.clamped_u * p.inverse_z;
  p.j11 = c.fy * p.inverse_z, p.j12 = -c.fy * p.clamped_v * p.inverse_z;
  for (int j = 0; j < 3; ++j) {
    p.JW[0][j] = p.j00 * c.W[0][j] + p.j02 * c.W[2][j];
    p.JW[1][j] = p.j11 * c.W[1][j] + p.j12 * c.W[2][j];
  }
  for (int i = 0; i < 2; ++i)
    for (int j = 0; j < 3; ++j) p.V[i][j] = p.JW[i][0] * p.M[0][j] + p.JW[i][1] * p.M[1][j] + p.JW[i][2] * p.M[2][j];
  const float xx = p.V[0][0] * p.V[0][0] + p.V[0][1] * p.V[0][1] + p.V[0][2] * p.V[0][2];
  const float yy = p.V[1][0] * p.V[1][0] + p.V[1][1] * p.V[1][1] + p.V[1][2] * p.V[1][2];
  p.cov_xy = p.V[0][0] * p.V[1][0] + p.V[0][1] * p.V[1][1] + p.V[0][2] * p.V[1][2];
  p.cov_xx = xx + c.low_pass;
  p.cov_yy = yy + c.low_pass;
  // Lagrange's identity: det(V V^T) = |V0 x V1|^2. The usual xx yy - xy^2 loses all its digits for long thin images.
  const float c0 = p.V[0][1] * p.V[1][2] - p.V[0][2] * p.V[1][1];
  const float c1 = p.V[0][2] * p.V[1][0] - p.V[0][0] * p.V[1][2];
  const float c2 = p.V[0][0] * p.V[1][1] - p.V[0][1] * p.V[1][0];
  const float determinant = (c0 * c0 + c1 * c1 + c2 * c2) + c.low_pass * (xx + yy) + c.low_pass * c.low_pass;
  p.inverse_determinant = 1.0f / determinant;
}

__device__ inline Projection project(const ViewConstants& c, const RawGaussian& g) {
  Projection p;
  project_position(c, g, p);
  shape_matrix(g, p);
  image_covariance(c, p);
  return p;
}

// Gaussians that can be rendered: in front of the near plane, of sane shape, nothing NaN or infinite.
__device__ inline bool renderable(const ViewConstants& c, const RawGaussian& g, const Projection& p) {
  bool ok = p.position[2] >= c.near_plane && p.position[2] <= kMaxDepth;
  ok = ok && p.q_norm2 >= kMinQuaternionNorm2 && p.q_norm2 <= kMaxQuaternionNorm2;
  for (int k = 0; k < 3; ++k) ok = ok && g.log_scale[k] >= kMinLogScale && g.log_scale[k] <= kMaxLogScale;
  ok = ok && fabsf(g.opacity_logit) <= kFinite;
  return ok && p.cov_xx + p.cov_yy <= kFinite && p.inverse_determinant > 0.0f;
}

}  // namespace ggslam::cuda
