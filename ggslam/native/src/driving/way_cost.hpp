// SPDX-License-Identifier: Apache-2.0
// What a metre costs at a clearance.
#pragma once

namespace ggslam::driving {

// 1 from the margin on, 1 + weight at the radius. In cells.
struct WayCost {
  float radius, margin, weight;

  float factor(float clearance) const {
    const float missing = margin > 0 ? (radius + margin - clearance) / margin : 0.0f;
    return missing <= 0 ? 1.0f : 1.0f + weight * (missing < 1 ? missing * missing : 1.0f);
  }
};

}  // namespace ggslam::driving
