// SPDX-License-Identifier: Apache-2.0
// A projected Gaussian, its exponent at a pixel, and whether it reaches a rectangle of pixels.
//
// Multiplications and additions are fused by hand: the compiler is then not free to round differently from one kernel
// to the next, so that counting and writing tiles, and forward and backward, always decide alike.
#pragma once
#include "rendering/rules.cuh"

namespace ggslam::cuda {

// As stored: three float4.
struct __align__(16) Splat {
  float mean_x, mean_y;  // pixels
  // With r = dx - slope_x dy: log2 alpha = log2_opacity + conic_r r^2 + conic_y dy^2. In dx and dy themselves the three
  // terms of a long, thin splat cancel and leave no digits, neither of alpha nor of its moments.
  float slope_x, conic_r;
  float conic_y, log2_opacity;
  float depth;
  float red, green, blue;
  float slope_y;         // the dy of highest alpha in a column is slope_y dx; in a row, dx is slope_x dy
};
static_assert(sizeof(Splat) == 48, "a splat is three float4");

// log2 of alpha at the offset (dx, dy) from the mean, before the limit kMaxAlpha.
__device__ inline float log2_alpha(const Splat& s, float dx, float dy) {
  const float r = fmaf(-s.slope_x, dy, dx);
  return fmaf(s.conic_r * r, r, fmaf(s.conic_y * dy, dy, s.log2_opacity));
}

// Whether alpha reaches 1/255 somewhere in a rectangle of pixel centres from (x, y) to (x + width, y + height). Exact: the
// highest value lies at the mean if that is inside, else on one of the two sides facing it, at the point of that side
// where the quadratic is highest.
__device__ inline bool reaches(const Splat& s, float x, float y, float width, float height) {
  constexpr float kMargin = 1e-3f;  // so that rounding never drops a pixel
  const float low_x = x - s.mean_x, high_x = low_x + width;
  const float low_y = y - s.mean_y, high_y = low_y + height;
  const float near_x = clamp(0.0f, low_x, high_x), near_y = clamp(0.0f, low_y, high_y);
  const float best_y = clamp(s.slope_y * near_x, low_y, high_y);  // on the vertical side facing the mean
  const float best_x = clamp(s.slope_x * near_y, low_x, high_x);  // on the horizontal side
  const float vertical = log2_alpha(s, near_x, best_y), horizontal = log2_alpha(s, best_x, near_y);
  return fmaxf(vertical, horizontal) >= kLog2MinAlpha - kMargin;
}

}  // namespace ggslam::cuda
