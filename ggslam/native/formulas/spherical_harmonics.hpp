// SPDX-License-Identifier: Apache-2.0
// Real spherical harmonics up to degree 3 of a unit direction (x, y, z), in the order and with the signs of 3D Gaussian
// Splatting (Kerbl et al. 2023): colour = 0.5 + sum_k basis_k(direction) sh_k. Compiled for CPU and GPU: see formulas.hpp.
#pragma once
#include "native/formulas/formulas.hpp"

namespace GGSLAM_FORMULAS {

constexpr float kSh0 = 0.28209479177387814f, kSh1 = 0.4886025119029199f;
constexpr float kSh2 = 1.0925484305920792f, kSh2z = 0.31539156525252005f, kSh2d = 0.5462742152960396f;
constexpr float kSh3a = 0.5900435899266435f, kSh3b = 2.890611442640554f, kSh3c = 0.4570457994644658f;
constexpr float kSh3d = 0.3731763325901154f, kSh3e = 1.445305721320277f;

// basis[0..count), count = 1, 4, 9 or 16.
GGSLAM_FORMULA void sh_basis(int count, Number x, Number y, Number z, Number* basis) {
  basis[0] = broadcast(kSh0);
  if (count < 4) return;
  basis[1] = -kSh1 * y, basis[2] = kSh1 * z, basis[3] = -kSh1 * x;
  if (count < 9) return;
  const Number xx = x * x, yy = y * y, zz = z * z;
  basis[4] = kSh2 * x * y;
  basis[5] = -kSh2 * y * z;
  basis[6] = kSh2z * (2.0f * zz - xx - yy);
  basis[7] = -kSh2 * x * z;
  basis[8] = kSh2d * (xx - yy);
  if (count < 16) return;
  basis[9] = -kSh3a * y * (3.0f * xx - yy);
  basis[10] = kSh3b * x * y * z;
  basis[11] = -kSh3c * y * (4.0f * zz - xx - yy);
  basis[12] = kSh3d * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
  basis[13] = -kSh3c * x * (4.0f * zz - xx - yy);
  basis[14] = kSh3e * z * (xx - yy);
  basis[15] = -kSh3a * x * (xx - 3.0f * yy);
}

// Gradient with respect to (x, y, z) of sum_k weight[k] basis_k.
GGSLAM_FORMULA void sh_direction_gradient(int count, Number x, Number y, Number z, const Number* weight, Number* gradient) {
  Number gx = {}, gy = {}, gz = {};
  if (count >= 4) {
    gx = -kSh1 * weight[3], gy = -kSh1 * weight[1], gz = kSh1 * weight[2];
  }
  if (count >= 9) {
    const Number w4 = kSh2 * weight[4], w5 = -kSh2 * weight[5], w6 = kSh2z * weight[6];
    const Number w7 = -kSh2 * weight[7], w8 = kSh2d * weight[8];
    gx += w4 * y - 2.0f * w6 * x + w7 * z + 2.0f * w8 * x;
    gy += w4 * x + w5 * z - 2.0f * w6 * y - 2.0f * w8 * y;
    gz += w5 * y + 4.0f * w6 * z + w7 * x;
  }
  if (count >= 16) {
    const Number xx = x * x, yy = y * y, zz = z * z;
    const Number w9 = -kSh3a * weight[9], w10 = kSh3b * weight[10], w11 = -kSh3c * weight[11];
    const Number w12 = kSh3d * weight[12], w13 = -kSh3c * weight[13], w14 = kSh3e * weight[14];
    const Number w15 = -kSh3a * weight[15];
    gx += 6.0f * w9 * x * y + w10 * y * z - 2.0f * w11 * x * y - 6.0f * w12 * x * z +
          w13 * (4.0f * zz - 3.0f * xx - yy) + 2.0f * w14 * x * z + 3.0f * w15 * (xx - yy);
    gy += 3.0f * w9 * (xx - yy) + w10 * x * z + w11 * (4.0f * zz - xx - 3.0f * yy) - 6.0f * w12 * y * z -
          2.0f * w13 * x * y - 2.0f * w14 * y * z - 6.0f * w15 * x * y;
    gz += w10 * x * y + 8.0f * w11 * y * z + w12 * (6.0f * zz - 3.0f * xx - 3.0f * yy) + 8.0f * w13 * x * z +
          w14 * (xx - yy);
  }
  gradient[0] = gx, gradient[1] = gy, gradient[2] = gz;
}

}  // namespace GGSLAM_FORMULAS
