// SPDX-License-Identifier: Apache-2.0
// Real spherical harmonics up to degree 3 of a unit direction (x, y, z), in the order and with the signs of 3D Gaussian
// Splatting (Kerbl et al. 2023): colour = 0.5 + sum_k basis_k(direction) sh_k.
#pragma once
#include "common/kernels/simd.hpp"

namespace ggslam::GGSLAM_ISA {

constexpr float kSh0 = 0.28209479177387814f;
constexpr float kSh1 = 0.4886025119029199f;
constexpr float kSh2[5] = {1.0925484305920792f, -1.0925484305920792f, 0.31539156525252005f, -1.0925484305920792f,
                           0.5462742152960396f};
constexpr float kSh3[7] = {-0.5900435899266435f, 2.890611442640554f, -0.4570457994644658f, 0.3731763325901154f,
                           -0.4570457994644658f, 1.445305721320277f, -0.5900435899266435f};

// basis[0..count), count = 1, 4, 9 or 16.
static inline void sh_basis(int count, Float x, Float y, Float z, Float* basis) {
  basis[0] = broadcast(kSh0);
  if (count < 4) return;
  basis[1] = -kSh1 * y, basis[2] = kSh1 * z, basis[3] = -kSh1 * x;
  if (count < 9) return;
  const Float xx = x * x, yy = y * y, zz = z * z;
  basis[4] = kSh2[0] * x * y;
  basis[5] = kSh2[1] * y * z;
  basis[6] = kSh2[2] * (2.0f * zz - xx - yy);
  basis[7] = kSh2[3] * x * z;
  basis[8] = kSh2[4] * (xx - yy);
  if (count < 16) return;
  basis[9] = kSh3[0] * y * (3.0f * xx - yy);
  basis[10] = kSh3[1] * x * y * z;
  basis[11] = kSh3[2] * y * (4.0f * zz - xx - yy);
  basis[12] = kSh3[3] * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
  basis[13] = kSh3[4] * x * (4.0f * zz - xx - yy);
  basis[14] = kSh3[5] * z * (xx - yy);
  basis[15] = kSh3[6] * x * (xx - 3.0f * yy);
}

// Gradient with respect to (x, y, z) of sum_k weight[k] basis_k.
static inline void sh_direction_gradient(int count, Float x, Float y, Float z, const Float* weight, Float* gradient) {
  Float gx = {}, gy = {}, gz = {};
  if (count >= 4) {
    gx = -kSh1 * weight[3], gy = -kSh1 * weight[1], gz = kSh1 * weight[2];
  }
  if (count >= 9) {
    const Float w4 = kSh2[0] * weight[4], w5 = kSh2[1] * weight[5], w6 = kSh2[2] * weight[6];
    const Float w7 = kSh2[3] * weight[7], w8 = kSh2[4] * weight[8];
    gx += w4 * y - 2.0f * w6 * x + w7 * z + 2.0f * w8 * x;
    gy += w4 * x + w5 * z - 2.0f * w6 * y - 2.0f * w8 * y;
    gz += w5 * y + 4.0f * w6 * z + w7 * x;
  }
  if (count >= 16) {
    const Float xx = x * x, yy = y * y, zz = z * z;
    const Float w9 = kSh3[0] * weight[9], w10 = kSh3[1] * weight[10], w11 = kSh3[2] * weight[11];
    const Float w12 = kSh3[3] * weight[12], w13 = kSh3[4] * weight[13], w14 = kSh3[5] * weight[14];
    const Float w15 = kSh3[6] * weight[15];
    gx += 6.0f * w9 * x * y + w10 * y * z - 2.0f * w11 * x * y - 6.0f * w12 * x * z +
          w13 * (4.0f * zz - 3.0f * xx - yy) + 2.0f * w14 * x * z + 3.0f * w15 * (xx - yy);
    gy += 3.0f * w9 * (xx - yy) + w10 * x * z + w11 * (4.0f * zz - xx - 3.0f * yy) - 6.0f * w12 * y * z -
          2.0f * w13 * x * y - 2.0f * w14 * y * z - 6.0f * w15 * x * y;
    gz += w10 * x * y + 8.0f * w11 * y * z + w12 * (6.0f * zz - 3.0f * xx - 3.0f * yy) + 8.0f * w13 * x * z +
          w14 * (xx - yy);
  }
  gradient[0] = gx, gradient[1] = gy, gradient[2] = gz;
}

}  // namespace ggslam::GGSLAM_ISA
