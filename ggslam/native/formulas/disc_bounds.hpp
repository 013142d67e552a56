// SPDX-License-Identifier: Apache-2.0
// Which discs may be the nearest of the voxels around a place. Two bounds: a disc is farther from a voxel than from the
// middle of some voxels less the way between them; and, as the distance of a convex body is convex, not nearer than it is
// from the middle with its slope there. The second tells far discs apart that the first cannot: nearly all that is far away
// is nearly as far.
//
// Stated for Floats, which are vectors in the core (volumes/kernels/esdf_near.hpp) and one number in a kernel
// (volumes/numbers.cuh). Those define their functions: product_sum(a, b, c) is a b + c, rounded in any way, inverse_root(a)
// 1 / root(a) within a thousandth, signed_as(a, b) is a >= 0 with the sign of b.
#pragma once
#include "native/formulas/formulas.hpp"

namespace GGSLAM_FORMULAS {

// The root of a number that is not negative, less up to a thousandth of it.
GGSLAM_FORMULA Float root_below(Float a) {
  const Float positive = maximum(a, broadcast(1e-12f));
  return positive * inverse_root(positive) * 0.9995f;
}

// What the square of the distance from a disc of some thickness is at least. `from` leads from its middle to the place.
GGSLAM_FORMULA Float least_square(const Float from[3], const Float normal[3], Float radius, Float half) {
  const Float height = product_sum(from[0], normal[0], product_sum(from[1], normal[1], from[2] * normal[2]));
  const Float square = product_sum(from[0], from[0], product_sum(from[1], from[1], from[2] * from[2]));
  const Float above = maximum(absolute(height) - half, Float{});
  const Float aside = maximum(root_below(product_sum(-height, height, square)) - radius, Float{});
  return product_sum(above, above, aside * aside);
}

// What is known of the nearest discs of some voxels: none of them is farther from its own than
// `most` + slope (voxel - middle).
struct Reach {
  float middle[3], half[3];  // of the voxels
  float slope[3];
  float most;
};

// Which discs of some thickness may be nearer to one of the voxels than what that has; `from` leads from their middles to
// that of the voxels.
GGSLAM_FORMULA Mask may_be_nearer(const Reach& reach, const Float from[3], const Float normal[3], Float radius,
                                  Float half) {
  const Float height = product_sum(from[0], normal[0], product_sum(from[1], normal[1], from[2] * normal[2]));
  const Float square = product_sum(from[0], from[0], product_sum(from[1], from[1], from[2] * from[2]));
  const Float above = maximum(absolute(height) - half, Float{});
  const Float aside_square = maximum(product_sum(-height, height, square), broadcast(1e-12f));
  const Float aside_inverse = inverse_root(aside_square);
  const Float beyond = maximum(aside_square * aside_inverse * 0.9995f - radius, Float{});
  const Float distance_square = maximum(product_sum(above, above, beyond * beyond), broadcast(1e-12f));
  const Float inverse = inverse_root(distance_square), distance = distance_square * inverse * 0.9995f;
  const Float along = beyond * aside_inverse * inverse;
  const Float across = signed_as(above, height) * inverse - height * along;
  Float least = distance;
  for (int a = 0; a < 3; ++a) {
    const Float slope = product_sum(from[a], along, normal[a] * across);
    least = product_sum(absolute(slope - reach.slope[a]), broadcast(-reach.half[a]), least);
  }
  // The slopes are rounded, too.
  return greater_equal(broadcast(reach.most + 0.01f), least);
}

}  // namespace GGSLAM_FORMULAS
