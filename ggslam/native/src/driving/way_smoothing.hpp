// SPDX-License-Identifier: Apache-2.0
// Makes a path over cells a smooth one that keeps its distance.
#pragma once
#include <vector>

#include "abi/core/planning.hpp"
#include "driving/way_grid.hpp"

namespace ggslam::driving {

// Replaces parts of a path by straight lines where these are clear and cost no more.
std::vector<Vec3<double>> pull_tight(const WayGrid& grid, const std::vector<Vec3<double>>& path,
                                     const SmoothingSettings& settings);

// Moves the points between the ends, pass by pass, towards their neighbours' middle and away from obstacles. A point
// moves only where both its lines stay clear, so that the path is as clear after any pass as it was before, and only as
// long as the whole does not get longer than it may.
std::vector<Vec3<double>> smooth(const WayGrid& grid, const std::vector<Vec3<double>>& path,
                                 const SmoothingSettings& settings);

}  // namespace ggslam::driving
