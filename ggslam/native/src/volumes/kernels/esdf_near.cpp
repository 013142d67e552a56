// SPDX-License-Identifier: Apache-2.0
#include "volumes/kernels/esdf_near.hpp"

namespace ggslam::GGSLAM_ISA {

int esdf_near(const volumes::NodeColumns& nodes, const float middle[3], float reach, float most, float* scratch,
              int32_t* out) {
  return nodes_near(nodes, middle, reach, most, scratch, out);
}

}  // namespace ggslam::GGSLAM_ISA
