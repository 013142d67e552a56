// SPDX-License-Identifier: Apache-2.0
#include <cstddef>

#include "volumes/occupancy_keys.hpp"

namespace ggslam::GGSLAM_ISA {

// Morton codes of the voxels of n points; -1 where a point is not finite or outside the grid.
void quantize_points(const float* points, std::size_t n, double factor, std::int64_t* codes) {
  for (std::size_t i = 0; i < n; ++i) {
    std::uint64_t code = 0;
    bool inside = true;
    for (int a = 0; a < 3; ++a) {
      const double key = std::floor(factor * points[3 * i + a]) + kKeyOffset;
      const bool good = key >= kKeyMargin && key < 2 * kKeyOffset - kKeyMargin;
      inside &= good;
      code |= spread_bits(static_cast<std::uint32_t>(good ? key : 0.0)) << a;
    }
    codes[i] = inside ? static_cast<std::int64_t>(code) : -1;
  }
}

// World points of the depth pixels z of one image row, columns u = 0, 1, ...: T ((u - cx) / fx z, y z, z, 1) with
// y = (v - cy) / fy of the row and T the upper three rows of T_world_camera. A pixel whose depth is not in [low, high]
// gives a point that is not a number.
void depth_row_to_world(const float* depth, int width, float fx, float cx, float y, const float T[12], float low,
                        float high, float* points) {
  for (int u = 0; u < width; ++u) {
    const float z = depth[u], x = (u - cx) / fx * z, yz = y * z;
    const bool good = z >= low && z <= high;
    for (int a = 0; a < 3; ++a) {
      const float value = T[4 * a] * x + T[4 * a + 1] * yz + T[4 * a + 2] * z + T[4 * a + 3];
      points[3 * u + a] = good ? value : __builtin_nanf("");
    }
  }
}

}  // namespace ggslam::GGSLAM_ISA
