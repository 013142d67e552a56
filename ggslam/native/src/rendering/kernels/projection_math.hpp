// SPDX-License-Identifier: Apache-2.0
// The projection of a vector of Gaussians.
#pragma once
#include "rendering/kernels/numbers.hpp"
#include "native/formulas/projection.hpp"

namespace ggslam::GGSLAM_ISA {

static inline RawGaussian load_gaussians(const GaussianArrays& arrays, const Rows& rows) {
  RawGaussian g;
  load_rows<3>(arrays.means, rows, g.mean);
  load_rows<4>(arrays.quaternions, rows, g.quaternion);
  load_rows<3>(arrays.log_scales, rows, g.log_scale);
  g.opacity_logit = load_column(arrays.opacity_logits, rows);
  return g;
}

}  // namespace ggslam::GGSLAM_ISA
