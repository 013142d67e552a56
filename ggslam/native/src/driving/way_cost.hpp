// SPDX-License-Identifier: Apache-2.0
// What a metre costs at a clearance.
#pragma once

namespace ggslam::driving {

// 1 from the margin on, 1 + weight at the radius. In cells.
struct WayCost {
  float radius, margin, weight;
  float per_margin;  // 1 / margin

  WayCost() = default;
  WayCost(float radius_, float margin_, float weight_)
      : radius(radius_), margin(margin_), weight(weight_), per_margin(margin_ > 0 ? 1 / margin_ : 0) {}

  float factor(float clearance) const {
    const float missing = (radius + margin - clearance) * per_margin;
    return missing <= 0 ? 1.0f : 1.0f + weight * (missing < 1 ? missing * missing : 1.0f);
  }
};

}  // namespace ggslam::driving
