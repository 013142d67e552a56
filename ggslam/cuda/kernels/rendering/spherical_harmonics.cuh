// SPDX-License-Identifier: Apache-2.0
// Real spherical harmonics up to degree 3 of a unit direction (x, y, z), in the order and with the signs of 3D Gaussian
// Splatting (Kerbl et al. 2023).
#pragma once
#include "rendering/rules.cuh"

namespace ggslam::cuda {

constexpr float kSh0 = 0.28209479177387814f, kSh1 = 0.4886025119029199f;
constexpr float kSh2 = 1.0925484305920792f, kSh2z = 0.31539156525252005f, kSh2d = 0.5462742152960396f;
constexpr float kSh3a = 0.5900435899266435f, kSh3b = 2.890611442640554f, kSh3c = 0.4570457994644658f;
constexpr float kSh3d = 0.3731763325901154f, kSh3e = 1.445305721320277f;

// basis[0..count), count = 1, 4, 9 or 16; the rest is zero, so that loops over all 16 may stay unrolled.
__device__ inline void sh_basis(int count, float x, float y, float z, float basis[16]) {
  const float xx = x * x, yy = y * y, zz = z * z;
  const bool first = count >= 4, second = count >= 9, third = count >= 16;
  basis[0] = kSh0;
  basis[1] = first ? -kSh1 * y : 0.0f;
  basis[2] = first ? kSh1 * z : 0.0f;
  basis[3] = first ? -kSh1 * x : 0.0f;
  basis[4] = second ? kSh2 * x * y : 0.0f;
  basis[5] = second ? -kSh2 * y * z : 0.0f;
  basis[6] = second ? kSh2z * (2.0f * zz - xx - yy) : 0.0f;
  basis[7] = second ? -kSh2 * x * z : 0.0f;
  basis[8] = second ? kSh2d * (xx - yy) : 0.0f;
  basis[9] = third ? -kSh3a * y * (3.0f * xx - yy) : 0.0f;
  basis[10] = third ? kSh3b * x * y * z : 0.0f;
  basis[11] = third ? -kSh3c * y * (4.0f * zz - xx - yy) : 0.0f;
  basis[12] = third ? kSh3d * z * (2.0f * zz - 3.0f * xx - 3.0f * yy) : 0.0f;
  basis[13] = third ? -kSh3c * x * (4.0f * zz - xx - yy) : 0.0f;
  basis[14] = third ? kSh3e * z * (xx - yy) : 0.0f;
  basis[15] = third ? -kSh3a * x * (xx - 3.0f * yy) : 0.0f;
}

// Gradient with respect to (x, y, z) of sum_k weight[k] basis_k; weights of coefficients that are not in use are zero.
__device__ inline void sh_direction_gradient(float x, float y, float z, const float weight[16], float gradient[3]) {
  const float xx = x * x, yy = y * y, zz = z * z;
  const float w4 = kSh2 * weight[4], w5 = -kSh2 * weight[5], w6 = kSh2z * weight[6];
  const float w7 = -kSh2 * weight[7], w8 = kSh2d * weight[8];
  const float w9 = -kSh3a * weight[9], w10 = kSh3b * weight[10], w11 = -kSh3c * weight[11];
  const float w12 = kSh3d * weight[12], w13 = -kSh3c * weight[13], w14 = kSh3e * weight[14];
  const float w15 = -kSh3a * weight[15];
  gradient[0] = -kSh1 * weight[3] + w4 * y - 2.0f * w6 * x + w7 * z + 2.0f * w8 * x + 6.0f * w9 * x * y + w10 * y * z -
                2.0f * w11 * x * y - 6.0f * w12 * x * z + w13 * (4.0f * zz - 3.0f * xx - yy) + 2.0f * w14 * x * z +
                3.0f * w15 * (xx - yy);
  gradient[1] = -kSh1 * weight[1] + w4 * x + w5 * z - 2.0f * w6 * y - 2.0f * w8 * y + 3.0f * w9 * (xx - yy) +
                w10 * x * z + w11 * (4.0f * zz - xx - 3.0f * yy) - 6.0f * w12 * y * z - 2.0f * w13 * x * y -
                2.0f * w14 * y * z - 6.0f * w15 * x * y;
  gradient[2] = kSh1 * weight[2] + w5 * y + 4.0f * w6 * z + w7 * x + w10 * x * y + 8.0f * w11 * y * z +
                w12 * (6.0f * zz - 3.0f * xx - 3.0f * yy) + 8.0f * w13 * x * z + w14 * (xx - yy);
}

}  // namespace ggslam::cuda
