// SPDX-License-Identifier: Apache-2.0
// The formulas that CPU and GPU share, for a vector of Gaussians: see ggslam/native/formulas.
#pragma once
#include "common/kernels/columns.hpp"
#include "native/formulas/formulas.hpp"
#include "rendering/rasterizer.hpp"

namespace ggslam::GGSLAM_ISA {

typedef Float Number;
typedef Mask Verdict;

}  // namespace ggslam::GGSLAM_ISA
