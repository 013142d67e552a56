// SPDX-License-Identifier: Apache-2.0
// Backward of projection.hpp: from the moments of a splat's log-alpha gradient and its depth gradient to the
// Gaussian's parameters and the camera pose.
//
// Everything goes by the sheared offsets S d = (r, dy), r = dx - slope dy, in which the exponent is
// -(conic_r r^2 + conic_y dy^2) / 2, D := diag(conic_r, conic_y). With the moments M of G over them, the gradient of
// the 2D covariance is S^T Q S, Q = D M D / 2, and that of V is S^T W with W = 2 Q (S V). In dx and dy the same sums
// are differences of numbers larger by the square of the splat's aspect ratio, and thin splats lose all digits.
#pragma once
#include "native/formulas/projection.hpp"

namespace GGSLAM_FORMULAS {

// Gradients of the image-space quantities, as summed over a Gaussian's slots.
struct SplatGradients {
  Number m0, mr, my, mrr, mry, myy;  // moments of G = d loss / d log(alpha) over the sheared offsets from the mean
  Number colour[3], depth;
};

struct ParameterGradients {
  Number mean[3], quaternion[4], log_scale[3], opacity_logit;
  Number twist[6];  // contribution to d loss / d xi, T_camera_world <- exp(xi) T_camera_world, translation first
};

// From d loss / d R (3x3, of the rotation matrix of the unit quaternion) to the quaternion before normalisation.
GGSLAM_FORMULA void quaternion_gradient(const Projection& p, const Number N[3][3], Number out[4]) {
  const Number w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
  Number g[4];
  g[0] = 2.0f * (z * (N[1][0] - N[0][1]) + y * (N[0][2] - N[2][0]) + x * (N[2][1] - N[1][2]));
  g[1] = 2.0f * (-2.0f * x * (N[1][1] + N[2][2]) + y * (N[0][1] + N[1][0]) + z * (N[0][2] + N[2][0]) +
                 w * (N[2][1] - N[1][2]));
  g[2] = 2.0f * (x * (N[0][1] + N[1][0]) - 2.0f * y * (N[0][0] + N[2][2]) + z * (N[1][2] + N[2][1]) +
                 w * (N[0][2] - N[2][0]));
  g[3] = 2.0f * (x * (N[0][2] + N[2][0]) + y * (N[1][2] + N[2][1]) - 2.0f * z * (N[0][0] + N[1][1]) +
                 w * (N[1][0] - N[0][1]));
  const Number along = g[0] * w + g[1] * x + g[2] * y + g[3] * z;
  for (int k = 0; k < 4; ++k) out[k] = (g[k] - along * p.q[k]) * p.q_inverse_norm;
}

// Scales and rotation; returns in dJ what flows on to J. cov = V V^T, V = (J W) M.
GGSLAM_FORMULA void shape_gradient(const ViewConstants& c, const Projection& p, const SplatGradients& g,
                                   Number dJ[2][3], ParameterGradients& out) {
  const Number qrr = p.conic_r * p.conic_r * g.mrr, qry = p.conic_r * p.conic_y * g.mry;
  const Number qyy = p.conic_y * p.conic_y * g.myy;
  Number dV[2][3], dR[3][3];
  for (int j = 0; j < 3; ++j) {
    const Number V0 = p.V[0][j] - p.slope * p.V[1][j];
    const Number first = qrr * V0 + qry * p.V[1][j], second = qry * V0 + qyy * p.V[1][j];
    out.log_scale[j] = first * V0 + second * p.V[1][j];  // d V / d log_scale = V
    dV[0][j] = first, dV[1][j] = second - p.slope * first;
    for (int i = 0; i < 3; ++i)
      dR[i][j] = ((p.JW[0][i] - p.slope * p.JW[1][i]) * first + p.JW[1][i] * second) * p.scale[j];
  }
  for (int i = 0; i < 2; ++i) {
    Number dJW[3];
    for (int j = 0; j < 3; ++j) dJW[j] = dV[i][0] * p.M[j][0] + dV[i][1] * p.M[j][1] + dV[i][2] * p.M[j][2];
    for (int j = 0; j < 3; ++j) dJ[i][j] = dJW[0] * c.W[j][0] + dJW[1] * c.W[j][1] + dJW[2] * c.W[j][2];
  }
  quaternion_gradient(p, dR, out.quaternion);
}

// direction_gradient: what already flows to the mean in the camera frame (through the viewing direction), which is kept
// apart because it does not take part in the camera's rotation.
GGSLAM_FORMULA ParameterGradients differentiate_projection(const ViewConstants& c, const RawGaussian& raw,
                                                           const Projection& p, const SplatGradients& g,
                                                           const Number direction_gradient[3]) {
  ParameterGradients out;
  Number dJ[2][3];
  shape_gradient(c, p, g, dJ, out);

  // Mean in the image: exponent's gradient S^T D (mr, my). Position: through the mean, the depth and the Jacobian.
  const Number mean_x = p.conic_r * g.mr, mean_y = p.conic_y * g.my - p.slope * mean_x;
  const Number iz = p.inverse_z, fx_iz = c.fx * iz, fy_iz = c.fy * iz;
  // Slopes beyond the frustum's margin are clamped in the Jacobian and pass no gradient there.
  const Verdict free_u = both(greater_equal(p.u, p.clamped_u), greater_equal(p.clamped_u, p.u));
  const Verdict free_v = both(greater_equal(p.v, p.clamped_v), greater_equal(p.clamped_v, p.v));
  const Number du = mean_x * c.fx - zero_unless(free_u, dJ[0][2] * fx_iz);
  const Number dv = mean_y * c.fy - zero_unless(free_v, dJ[1][2] * fy_iz);
  Number position[3];
  position[0] = du * iz;
  position[1] = dv * iz;
  position[2] = g.depth - (du * p.u + dv * p.v + dJ[0][0] * fx_iz + dJ[1][1] * fy_iz + dJ[0][2] * p.j02 +
                           dJ[1][2] * p.j12) * iz;

  // Rotating the camera by omega turns the position and W, on which J W depends: <J^T dJ, [omega]x>.
  const Number* t = p.position;
  const Number k01 = p.j00 * dJ[0][1], k10 = p.j11 * dJ[1][0], k02 = p.j00 * dJ[0][2], k12 = p.j11 * dJ[1][2];
  const Number k20 = p.j02 * dJ[0][0] + p.j12 * dJ[1][0], k21 = p.j02 * dJ[0][1] + p.j12 * dJ[1][1];
  out.twist[3] = t[1] * position[2] - t[2] * position[1] + (k21 - k12);
  out.twist[4] = t[2] * position[0] - t[0] * position[2] + (k02 - k20);
  out.twist[5] = t[0] * position[1] - t[1] * position[0] + (k10 - k01);
  for (int i = 0; i < 3; ++i) out.twist[i] = position[i] = position[i] + direction_gradient[i];

  for (int j = 0; j < 3; ++j)
    out.mean[j] = c.W[0][j] * position[0] + c.W[1][j] * position[1] + c.W[2][j] * position[2];
  out.opacity_logit = g.m0 * sigmoid(-raw.opacity_logit);  // d log(sigmoid(x)) / d x = sigmoid(-x)
  return out;
}

}  // namespace GGSLAM_FORMULAS
