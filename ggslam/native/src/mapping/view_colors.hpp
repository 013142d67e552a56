// SPDX-License-Identifier: Apache-2.0
// Colours that depend on the view, fitted to what views show: what threads and kernel share.
#pragma once
#include <cstdint>

#include "common/dispatch.hpp"
#include "abi/core/mapping.hpp"

namespace ggslam {

// Numbers of a Gaussian's equations with `count` unknowns: the lower triangle, row by row, and three right sides each.
constexpr int view_color_floats(int count) { return count * (count + 1) / 2 + 3 * count; }

constexpr int kMostViewColors = 15;

}  // namespace ggslam

// Adds one view to the equations of Gaussians [begin, end).
GGSLAM_DECLARE_KERNEL(void view_colors_add(const ViewColorsOfView& job, std::int64_t begin, std::int64_t end))
