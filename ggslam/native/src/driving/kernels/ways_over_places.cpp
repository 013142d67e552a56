// SPDX-License-Identifier: Apache-2.0
// What is left from cells to a goal over the best of some places, along ways over cells that all may be entered.
#include <algorithm>
#include <cmath>

namespace ggslam::GGSLAM_ISA {

// `places`: x, y, z, what is left from there, what a cell's length costs up to there. `left` [count] is lowered.
void ways_over_places(const float* x, const float* y, const float* z, int count, const float* places, int number,
                      float* left) {
  for (int n = 0; n < number; ++n, places += 5) {
    const float px = places[0], py = places[1], pz = places[2], value = places[3], factor = places[4];
    for (int i = 0; i < count; ++i) {
      const float dx = std::fabs(x[i] - px), dy = std::fabs(y[i] - py), dz = std::fabs(z[i] - pz);
      const float most = std::max(std::max(dx, dy), dz), least = std::min(std::min(dx, dy), dz);
      // Steps across all three axes, then across two, then along one.
      const float steps = most + 0.41421356f * (dx + dy + dz - most - least) + 0.31783725f * least;
      left[i] = std::min(left[i], value + factor * steps);
    }
  }
}

}  // namespace ggslam::GGSLAM_ISA
