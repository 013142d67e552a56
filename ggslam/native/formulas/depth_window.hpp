// SPDX-License-Identifier: Apache-2.0
// A point of a depth image with the surface around it, from its neighbours in the image. Compiled for CPU and GPU: see
// formulas.hpp.
#pragma once
#include <cmath>
#include <cstdlib>

#include "abi/core/tracking.hpp"
#include "native/formulas/symmetric3.hpp"

namespace GGSLAM_FORMULAS {

// Scatter of the neighbours of (u, v) that lie on the same surface, about their mean; false if they are too few.
// Of a pair of neighbours on opposite sides both or none count, so that the mean of a border point's window stays at
// the point.
GGSLAM_FORMULA bool window_scatter(const float* depth, const DepthPointsSettings& s, int u, int v, float z,
                                   float (&scatter)[6]) {
  const float sigma = s.noise_constant + s.noise_square * z * z;
  // A surface seen at an angle of up to about 75 degrees changes its depth by 4 z / f per pixel.
  const float slope = 4.0f * z / s.fx;
  const float x0 = (u - s.cx) / s.fx, y0 = (v - s.cy) / s.fy;
  float n = 0, sum[3] = {0, 0, 0}, outer[6] = {0, 0, 0, 0, 0, 0};
  for (int j = -s.window; j <= s.window; ++j)
    for (int i = -s.window; i <= s.window; ++i) {
      const int du = i * s.window_step, dv = j * s.window_step;
      const float e = depth[(v + dv) * s.width + u + du];
      const float reach = slope * (std::abs(du) > std::abs(dv) ? std::abs(du) : std::abs(dv)) + 3.0f * sigma;
      if (!(e > 0) || std::fabs(e - z) > reach) continue;
      const float x = (x0 + du / s.fx) * e - x0 * z, y = (y0 + dv / s.fy) * e - y0 * z, d = e - z;
      n += 1;
      sum[0] += x, sum[1] += y, sum[2] += d;
      outer[0] += x * x, outer[1] += x * y, outer[2] += x * d;
      outer[3] += y * y, outer[4] += y * d, outer[5] += d * d;
    }
  const int side = 2 * s.window + 1;
  if (n < s.min_neighbours * side * side) return false;
  const float f = 1 / n;
  int k = 0;
  for (int a = 0; a < 3; ++a)
    for (int b = a; b < 3; ++b, ++k) scatter[k] = f * outer[k] - f * f * sum[a] * sum[b];
  return true;
}

// Writes point, normal (towards the camera) and packed covariance of pixel (u, v); returns the point's weight.
GGSLAM_FORMULA float describe_point(const DepthPointsSettings& s, int u, int v, float z, const float (&scatter)[6],
                                    float* point, float* normal, float* covariance) {
  float values[3], axes[3][3], shape[3];
  eigen_symmetric3(scatter, values, axes);
  point[0] = (u - s.cx) / s.fx * z, point[1] = (v - s.cy) / s.fy * z, point[2] = z;
  const float facing = axes[2][0] * point[0] + axes[2][1] * point[1] + axes[2][2] * point[2];
  for (int i = 0; i < 3; ++i) normal[i] = facing > 0 ? -axes[2][i] : axes[2][i];
  // The measured thickness contains the noise of the depth seen along the normal; what remains is the surface's.
  const float sigma = s.noise_constant + s.noise_square * z * z;
  const float along = facing * facing / (point[0] * point[0] + point[1] * point[1] + z * z);
  values[2] = larger_of(values[2] - 2 * sigma * sigma * along, 0.0f);
  regularized_axes(values, s.min_thickness, 1.0f, s.max_elongation, shape);
  compose_symmetric3(shape, axes, covariance);
  const float ratio = (s.noise_constant + s.noise_square) / sigma;
  return smaller_of(ratio * ratio, s.max_weight);
}

}  // namespace GGSLAM_FORMULAS
