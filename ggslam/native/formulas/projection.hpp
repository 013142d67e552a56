// SPDX-License-Identifier: Apache-2.0
// Projection of Gaussians by elliptical weighted averaging (Zwicker et al. 2001, "EWA splatting"): the image of the
// covariance Sigma = M M^T, M = R(q) diag(exp(log_scale)), under the linearised projection J W is V V^T + low_pass I
// with V = J W M. Forward and backward share these terms, so that they can never disagree.
// Compiled for CPU and GPU: see formulas.hpp.
#pragma once
#include "abi/core/rendering.hpp"
#include "native/formulas/formulas.hpp"
#include "native/formulas/rendering_rules.hpp"

namespace GGSLAM_FORMULAS {

// The camera as scalars, with the limits of the slopes x/z and y/z that the Jacobian uses.
struct ViewConstants {
  float W[3][3], t[3];
  float fx, fy, cx, cy, near_plane, low_pass;
  float min_u, max_u, min_v, max_v;
};

GGSLAM_HOST_FORMULA ViewConstants view_constants(const CameraView& view) {
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

struct RawGaussian {
  Number mean[3], quaternion[4], log_scale[3], opacity_logit;
};

struct Projection {
  Number position[3];          // mean in the camera frame
  Number inverse_z, u, v;      // 1/z, x/z, y/z
  Number clamped_u, clamped_v;
  Number q[4], q_norm2, q_inverse_norm;
  Number scale[3], M[3][3];
  Number j00, j02, j11, j12;   // Jacobian of the projection; j01 = j10 = 0
  Number JW[2][3], V[2][3];
  Number cov_xx, cov_xy, cov_yy, inverse_determinant;
  // The inverse covariance is S^T diag(conic_r, conic_y) S with S = (1, -slope; 0, 1): each factor has all its digits.
  Number slope, conic_r, conic_y;
};

GGSLAM_FORMULA void rotation_matrix(const Number q[4], Number R[3][3]) {
  const Number w = q[0], x = q[1], y = q[2], z = q[3];
  R[0][0] = 1.0f - 2.0f * (y * y + z * z), R[0][1] = 2.0f * (x * y - w * z), R[0][2] = 2.0f * (x * z + w * y);
  R[1][0] = 2.0f * (x * y + w * z), R[1][1] = 1.0f - 2.0f * (x * x + z * z), R[1][2] = 2.0f * (y * z - w * x);
  R[2][0] = 2.0f * (x * z - w * y), R[2][1] = 2.0f * (y * z + w * x), R[2][2] = 1.0f - 2.0f * (x * x + y * y);
}

GGSLAM_FORMULA Projection project(const ViewConstants& c, const RawGaussian& g) {
  Projection p;
  for (int i = 0; i < 3; ++i)
    p.position[i] = c.W[i][0] * g.mean[0] + (c.W[i][1] * g.mean[1] + (c.W[i][2] * g.mean[2] + c.t[i]));
  p.inverse_z = 1.0f / maximum(p.position[2], broadcast(c.near_plane));
  p.u = p.position[0] * p.inverse_z;
  p.v = p.position[1] * p.inverse_z;
  p.clamped_u = clamp(p.u, broadcast(c.min_u), broadcast(c.max_u));
  p.clamped_v = clamp(p.v, broadcast(c.min_v), broadcast(c.max_v));

  p.q_norm2 = g.quaternion[0] * g.quaternion[0] + g.quaternion[1] * g.quaternion[1] +
              g.quaternion[2] * g.quaternion[2] + g.quaternion[3] * g.quaternion[3];
  p.q_inverse_norm = 1.0f / square_root(p.q_norm2);
  for (int k = 0; k < 4; ++k) p.q[k] = g.quaternion[k] * p.q_inverse_norm;
  Number R[3][3];
  rotation_matrix(p.q, R);
  for (int j = 0; j < 3; ++j) {
    p.scale[j] = exponential(g.log_scale[j]);
    for (int i = 0; i < 3; ++i) p.M[i][j] = R[i][j] * p.scale[j];
  }

  p.j00 = c.fx * p.inverse_z, p.j02 = -c.fx * p.clamped_u * p.inverse_z;
  p.j11 = c.fy * p.inverse_z, p.j12 = -c.fy * p.clamped_v * p.inverse_z;
  for (int j = 0; j < 3; ++j) {
    p.JW[0][j] = p.j00 * c.W[0][j] + p.j02 * c.W[2][j];
    p.JW[1][j] = p.j11 * c.W[1][j] + p.j12 * c.W[2][j];
  }
  for (int i = 0; i < 2; ++i)
    for (int j = 0; j < 3; ++j) p.V[i][j] = p.JW[i][0] * p.M[0][j] + p.JW[i][1] * p.M[1][j] + p.JW[i][2] * p.M[2][j];
  const Number xx = p.V[0][0] * p.V[0][0] + p.V[0][1] * p.V[0][1] + p.V[0][2] * p.V[0][2];
  const Number yy = p.V[1][0] * p.V[1][0] + p.V[1][1] * p.V[1][1] + p.V[1][2] * p.V[1][2];
  p.cov_xy = p.V[0][0] * p.V[1][0] + p.V[0][1] * p.V[1][1] + p.V[0][2] * p.V[1][2];
  p.cov_xx = xx + c.low_pass;
  p.cov_yy = yy + c.low_pass;
  // Lagrange's identity: det(V V^T) = |V0 x V1|^2. The usual xx yy - xy^2 loses all its digits for long thin images.
  const Number c0 = p.V[0][1] * p.V[1][2] - p.V[0][2] * p.V[1][1];
  const Number c1 = p.V[0][2] * p.V[1][0] - p.V[0][0] * p.V[1][2];
  const Number c2 = p.V[0][0] * p.V[1][1] - p.V[0][1] * p.V[1][0];
  const Number determinant = (c0 * c0 + c1 * c1 + c2 * c2) + c.low_pass * (xx + yy) + c.low_pass * c.low_pass;
  p.inverse_determinant = 1.0f / determinant;
  p.conic_r = p.cov_yy * p.inverse_determinant;
  p.conic_y = 1.0f / p.cov_yy;
  p.slope = p.cov_xy / p.cov_yy;
  return p;
}

// Gaussians that can be rendered: in front of the near plane, of sane shape, nothing NaN or infinite.
GGSLAM_FORMULA Verdict renderable(const ViewConstants& c, const RawGaussian& g, const Projection& p) {
  Verdict ok = greater_equal(p.position[2], broadcast(c.near_plane));
  ok = both(ok, greater_equal(broadcast(kMaxDepth), p.position[2]));
  ok = both(ok, greater_equal(p.q_norm2, broadcast(kMinQuaternionNorm2)));
  ok = both(ok, greater_equal(broadcast(kMaxQuaternionNorm2), p.q_norm2));
  for (int k = 0; k < 3; ++k) {
    ok = both(ok, greater_equal(g.log_scale[k], broadcast(kMinLogScale)));
    ok = both(ok, greater_equal(broadcast(kMaxLogScale), g.log_scale[k]));
  }
  const Number finite = broadcast(kFinite);
  ok = both(ok, greater_equal(finite, absolute(g.opacity_logit)));
  return both(ok, both(greater_equal(finite, p.cov_xx + p.cov_yy), greater(p.inverse_determinant, broadcast(0.0f))));
}

// Unit directions from the camera centre to the means, in the world frame: W^T position / |position|;
// returns 1 / |position|.
GGSLAM_FORMULA Number viewing_direction(const ViewConstants& c, const Number position[3], Number direction[3]) {
  const Number inverse_length =
      1.0f / square_root(position[0] * position[0] + position[1] * position[1] + position[2] * position[2]);
  for (int i = 0; i < 3; ++i)
    direction[i] =
        (c.W[0][i] * position[0] + c.W[1][i] * position[1] + c.W[2][i] * position[2]) * inverse_length;
  return inverse_length;
}

}  // namespace GGSLAM_FORMULAS
