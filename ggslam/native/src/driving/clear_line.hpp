// SPDX-License-Identifier: Apache-2.0
// Straight lines through the interpolated clearance, looked at everywhere and not at samples.
#pragma once
#include "driving/way_cost.hpp"
#include "driving/way_grid.hpp"

namespace ggslam::driving {

// Whether the interpolated clearance is at least `cost.radius` all along a line; if so, `sum` (may be null) is what the
// line costs.
bool is_clear(CellReader& reader, const Vec3<double>& from, const Vec3<double>& to, const WayCost& cost, double* sum);

// The least interpolated clearance along a line; NaN where it passes beside a cell that may not be entered.
float least_clearance(CellReader& reader, const Vec3<double>& from, const Vec3<double>& to);

}  // namespace ggslam::driving
