// SPDX-License-Identifier: Apache-2.0
// Colour of Gaussians as seen from the camera, and its derivatives. Whoever uses a colour cuts it off at black.
#pragma once
#include "rendering/kernels/projection_math.hpp"
#include "native/formulas/spherical_harmonics.hpp"

namespace ggslam::GGSLAM_ISA {

static inline Float load_sh(const GaussianArrays& arrays, const Rows& rows, int k, int channel) {
  Float v;
  for (int lane = 0; lane < kLanes; ++lane) {
    const std::size_t row = rows.numbers[lane];
    v[lane] = arrays.sh[(row * arrays.sh_coefficients + k) * 3 + channel];
  }
  return v;
}

static inline void view_colour(const GaussianArrays& arrays, const ViewConstants& c, const Rows& rows,
                               const Float position[3], Float colour[3]) {
  if (arrays.sh_coefficients == 1) {
    load_rows<3>(arrays.sh, rows, colour);
    for (int channel = 0; channel < 3; ++channel) colour[channel] = 0.5f + kSh0 * colour[channel];
    return;
  }
  Float direction[3], basis[16];
  viewing_direction(c, position, direction);
  sh_basis(arrays.active_sh_coefficients, direction[0], direction[1], direction[2], basis);
  for (int channel = 0; channel < 3; ++channel) {
    colour[channel] = broadcast(0.5f);
    for (int k = 0; k < arrays.active_sh_coefficients; ++k)
      colour[channel] += basis[k] * load_sh(arrays, rows, k, channel);
  }
}

// The gradient of the colour before it was cut off at black, from that after it: what is cut off can only brighten.
static inline void differentiate_cut_at_black(const GaussianArrays& arrays, const ViewConstants& c,
                                              const Rows& rows, const Float position[3],
                                              Float colour_gradient[3]) {
  Float colour[3];
  view_colour(arrays, c, rows, position, colour);
  for (int channel = 0; channel < 3; ++channel)
    colour_gradient[channel] = select(greater(Float{}, colour[channel]), minimum(colour_gradient[channel], Float{}),
                                      colour_gradient[channel]);
}

// From the gradient of the colour: that of the coefficients is basis[k] * colour_gradient[channel]; returns in
// `position_gradient` (camera frame) what flows through the viewing direction. Moving the camera by a left
// perturbation (v, omega) of T_camera_world changes the direction by v only: rotating the camera does not.
static inline void differentiate_view_colour(const GaussianArrays& arrays, const ViewConstants& c,
                                             const Rows& rows, const Float position[3],
                                             const Float colour_gradient[3], Float basis[16],
                                             Float position_gradient[3]) {
  const int count = arrays.active_sh_coefficients;
  for (int i = 0; i < 3; ++i) position_gradient[i] = Float{};
  basis[0] = broadcast(kSh0);
  if (count == 1) return;
  Float d[3], weight[16], g[3];
  const Float inverse_length = viewing_direction(c, position, d);
  sh_basis(count, d[0], d[1], d[2], basis);
  for (int k = 1; k < count; ++k) {
    weight[k] = Float{};
    for (int channel = 0; channel < 3; ++channel)
      weight[k] += colour_gradient[channel] * load_sh(arrays, rows, k, channel);
  }
  sh_direction_gradient(count, d[0], d[1], d[2], weight, g);
  const Float along = g[0] * d[0] + g[1] * d[1] + g[2] * d[2];
  for (int i = 0; i < 3; ++i) g[i] = (g[i] - along * d[i]) * inverse_length;  // world frame
  for (int i = 0; i < 3; ++i) position_gradient[i] = c.W[i][0] * g[0] + c.W[i][1] * g[1] + c.W[i][2] * g[2];
}

}  // namespace ggslam::GGSLAM_ISA
