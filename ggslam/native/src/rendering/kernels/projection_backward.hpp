// SPDX-License-Identifier: Apache-2.0
// Backward of projection_math.hpp: from the moments of a splat's log-alpha gradient and its depth gradient to the
// Gaussian's parameters and the camera pose.
//
// Everything goes by the sheared offsets S d = (r, dy), r = dx - slope dy, in which the exponent is
// -(conic_r r^2 + conic_y dy^2) / 2, D := diag(conic_r, conic_y). With the moments M of G over them, the gradient of
// the 2D covariance is S^T Q S, Q = D M D / 2, and that of V is S^T W with W = 2 Q (S V). In dx and dy the same sums
// are differences of numbers larger by the square of the splat's aspect ratio, and thin splats lose all digits.
#pragma once
#include "rendering/kernels/projection_math.hpp"

namespace ggslam::GGSLAM_ISA {

// Gradients of the image-space quantities, as summed over a Gaussian's slots.
struct SplatGradients {
  Float m0, mr, my, mrr, mry, myy;  // moments of G = d loss / d log(alpha) over the sheared offsets from the mean
  Float colour[3], depth;
};

struct ParameterGradients {
  Float mean[3], quaternion[4], log_scale[3], opacity_logit;
  Float twist[6];  // contribution to d loss / d xi, T_camera_world <- exp(xi) T_camera_world, translation first
};

// Gradients of the rows of V, and what the parameters of the shape need of them: S V, S J W and W, each one's first
// row (their second rows are those of V and J W, and row 1 of W).
struct ShearedGradients {
  Float dV[2][3], first[3], second[3], V0[3], JW0[3];
};

static inline ShearedGradients covariance_gradient(const Projection& p, const SplatGradients& g) {
  const Float qrr = p.conic_r * p.conic_r * g.mrr, qry = p.conic_r * p.conic_y * g.mry;  // of 2 Q
  const Float qyy = p.conic_y * p.conic_y * g.myy;
  ShearedGradients out;
  for (int j = 0; j < 3; ++j) {
    out.V0[j] = p.V[0][j] - p.slope * p.V[1][j];
    out.JW0[j] = p.JW[0][j] - p.slope * p.JW[1][j];
    out.first[j] = qrr * out.V0[j] + qry * p.V[1][j];
    out.second[j] = qry * out.V0[j] + qyy * p.V[1][j];
    out.dV[0][j] = out.first[j];
    out.dV[1][j] = out.second[j] - p.slope * out.first[j];
  }
  return out;
}

// From d loss / d R (3x3, of the rotation matrix of the unit quaternion) to the quaternion before normalisation.
static inline void quaternion_gradient(const Projection& p, const Float N[3][3], Float out[4]) {
  const Float w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
  Float g[4];
  g[0] = 2.0f * (z * (N[1][0] - N[0][1]) + y * (N[0][2] - N[2][0]) + x * (N[2][1] - N[1][2]));
  g[1] = 2.0f * (-2.0f * x * (N[1][1] + N[2][2]) + y * (N[0][1] + N[1][0]) + z * (N[0][2] + N[2][0]) +
                 w * (N[2][1] - N[1][2]));
  g[2] = 2.0f * (x * (N[0][1] + N[1][0]) - 2.0f * y * (N[0][0] + N[2][2]) + z * (N[1][2] + N[2][1]) +
                 w * (N[0][2] - N[2][0]));
  g[3] = 2.0f * (x * (N[0][2] + N[2][0]) + y * (N[1][2] + N[2][1]) - 2.0f * z * (N[0][0] + N[1][1]) +
                 w * (N[1][0] - N[0][1]));
  const Float along = g[0] * w + g[1] * x + g[2] * y + g[3] * z;
  for (int k = 0; k < 4; ++k) out[k] = (g[k] - along * p.q[k]) * p.q_inverse_norm;
}

// position_gradient: what already flows to the mean in the camera frame (through the viewing direction), which is kept
// apart because it does not take part in the camera's rotation.
static inline ParameterGradients differentiate_projection(const ViewConstants& c, const RawGaussians& raw,
                                                          const Projection& p, const SplatGradients& g,
                                                          const Float direction_gradient[3]) {
  ParameterGradients out;
  // cov = V V^T, V = (J W) M.
  const ShearedGradients s = covariance_gradient(p, g);
  const auto& dV = s.dV;
  Float dJW[2][3], dJ[2][3], dR[3][3];
  for (int i = 0; i < 2; ++i)
    for (int j = 0; j < 3; ++j) dJW[i][j] = dV[i][0] * p.M[j][0] + dV[i][1] * p.M[j][1] + dV[i][2] * p.M[j][2];
  for (int i = 0; i < 2; ++i)
    for (int j = 0; j < 3; ++j) dJ[i][j] = dJW[i][0] * c.W[j][0] + dJW[i][1] * c.W[j][1] + dJW[i][2] * c.W[j][2];
  for (int j = 0; j < 3; ++j) {
    out.log_scale[j] = s.first[j] * s.V0[j] + s.second[j] * p.V[1][j];  // d V / d log_scale = V
    for (int i = 0; i < 3; ++i) dR[i][j] = (s.JW0[i] * s.first[j] + p.JW[1][i] * s.second[j]) * p.scale[j];
  }
  quaternion_gradient(p, dR, out.quaternion);

  // Mean in the image: exponent's gradient S^T D (mr, my). Position: through the mean, the depth and the Jacobian.
  const Float mean_x = p.conic_r * g.mr, mean_y = p.conic_y * g.my - p.slope * mean_x;
  const Float iz = p.inverse_z, fx_iz = c.fx * iz, fy_iz = c.fy * iz;
  // Slopes beyond the frustum's margin are clamped in the Jacobian and pass no gradient there.
  const Mask free_u = both(greater_equal(p.u, p.clamped_u), greater_equal(p.clamped_u, p.u));
  const Mask free_v = both(greater_equal(p.v, p.clamped_v), greater_equal(p.clamped_v, p.v));
  const Float du = mean_x * c.fx - zero_unless(free_u, dJ[0][2] * fx_iz);
  const Float dv = mean_y * c.fy - zero_unless(free_v, dJ[1][2] * fy_iz);
  Float position[3];
  position[0] = du * iz;
  position[1] = dv * iz;
  position[2] = g.depth - (du * p.u + dv * p.v + dJ[0][0] * fx_iz + dJ[1][1] * fy_iz + dJ[0][2] * p.j02 +
                           dJ[1][2] * p.j12) * iz;

  // Rotating the camera by omega turns the position and W, on which J W depends: <J^T dJ, [omega]x>.
  const Float* t = p.position;
  const Float k01 = p.j00 * dJ[0][1], k10 = p.j11 * dJ[1][0], k02 = p.j00 * dJ[0][2], k12 = p.j11 * dJ[1][2];
  const Float k20 = p.j02 * dJ[0][0] + p.j12 * dJ[1][0], k21 = p.j02 * dJ[0][1] + p.j12 * dJ[1][1];
  out.twist[3] = t[1] * position[2] - t[2] * position[1] + (k21 - k12);
  out.twist[4] = t[2] * position[0] - t[0] * position[2] + (k02 - k20);
  out.twist[5] = t[0] * position[1] - t[1] * position[0] + (k10 - k01);
  for (int i = 0; i < 3; ++i) out.twist[i] = position[i] = position[i] + direction_gradient[i];

  for (int j = 0; j < 3; ++j)
    out.mean[j] = c.W[0][j] * position[0] + c.W[1][j] * position[1] + c.W[2][j] * position[2];
  out.opacity_logit = g.m0 * sigmoid(-raw.opacity_logit);  // d log(sigmoid(x)) / d x = sigmoid(-x)
  return out;
}

}  // namespace ggslam::GGSLAM_ISA
