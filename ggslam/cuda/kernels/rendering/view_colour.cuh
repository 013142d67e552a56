// SPDX-License-Identifier: Apache-2.0
// Colour of a Gaussian as seen from the camera, and its derivatives. Whoever uses a colour cuts it off at black.
#pragma once
#include "rendering/projection.cuh"
#include "native/formulas/spherical_harmonics.hpp"

namespace ggslam::cuda {

// All 16 values of the basis; those beyond `count` are zero, so that loops over all of them may stay unrolled.
__device__ inline void whole_sh_basis(int count, const float direction[3], float basis[16]) {
#pragma unroll
  for (int k = 0; k < 16; ++k) basis[k] = 0.0f;
  sh_basis(count, direction[0], direction[1], direction[2], basis);
}

__device__ inline void view_colour(const GaussianArrays& arrays, const ViewConstants& c, std::int64_t row,
                                   const float position[3], float colour[3]) {
  const float* sh = arrays.sh + row * arrays.sh_coefficients * 3;
  if (arrays.active_sh_coefficients == 1) {
    for (int channel = 0; channel < 3; ++channel) colour[channel] = 0.5f + kSh0 * sh[channel];
    return;
  }
  float direction[3], basis[16];
  viewing_direction(c, position, direction);
  whole_sh_basis(arrays.active_sh_coefficients, direction, basis);
  for (int channel = 0; channel < 3; ++channel) colour[channel] = 0.5f;
#pragma unroll
  for (int k = 0; k < 16; ++k)
    if (k < arrays.active_sh_coefficients)
      for (int channel = 0; channel < 3; ++channel) colour[channel] += basis[k] * sh[3 * k + channel];
}

// The gradient of the colour before it was cut off at black, from that after it: what is cut off can only brighten.
__device__ inline void differentiate_cut_at_black(const GaussianArrays& arrays, const ViewConstants& c,
                                                  std::int64_t row, const float position[3],
                                                  float colour_gradient[3]) {
  float colour[3];
  view_colour(arrays, c, row, position, colour);
  for (int channel = 0; channel < 3; ++channel)
    if (colour[channel] < 0.0f) colour_gradient[channel] = fminf(colour_gradient[channel], 0.0f);
}

// From the gradient of the colour: that of the coefficients is basis[k] * colour_gradient[channel]; returns in
// `position_gradient` (camera frame) what flows through the viewing direction. Moving the camera by a left
// perturbation (v, omega) of T_camera_world changes the direction by v only: rotating the camera does not.
__device__ inline void differentiate_view_colour(const GaussianArrays& arrays, const ViewConstants& c,
                                                 std::int64_t row, const float position[3],
                                                 const float colour_gradient[3], float basis[16],
                                                 float position_gradient[3]) {
  const int count = arrays.active_sh_coefficients;
  float d[3];
  const float inverse_length = viewing_direction(c, position, d);
  whole_sh_basis(count, d, basis);
  for (int i = 0; i < 3; ++i) position_gradient[i] = 0.0f;
  if (count == 1) return;
  const float* sh = arrays.sh + row * arrays.sh_coefficients * 3;
  float weight[16], g[3];
  weight[0] = 0.0f;
#pragma unroll
  for (int k = 1; k < 16; ++k) {
    weight[k] = 0.0f;
    if (k < count)
      for (int channel = 0; channel < 3; ++channel) weight[k] += colour_gradient[channel] * sh[3 * k + channel];
  }
  sh_direction_gradient(count, d[0], d[1], d[2], weight, g);
  const float along = g[0] * d[0] + g[1] * d[1] + g[2] * d[2];
  for (int i = 0; i < 3; ++i) g[i] = (g[i] - along * d[i]) * inverse_length;  // world frame
  for (int i = 0; i < 3; ++i) position_gradient[i] = c.W[i][0] * g[0] + c.W[i][1] * g[1] + c.W[i][2] * g[2];
}

}  // namespace ggslam::cuda
