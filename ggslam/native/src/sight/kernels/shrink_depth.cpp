// SPDX-License-Identifier: Apache-2.0
// The nearest depth of each place, a row of places at a time: down the columns first, then along the row.
#include <algorithm>
#include <limits>

#include "sight/places.hpp"

namespace ggslam::GGSLAM_ISA {

void shrink_depth_row(const float* depth, int width, int factor, float* nearest, float* smaller) {
  constexpr float kNothing = std::numeric_limits<float>::infinity();
  const int places = width / factor;
  std::fill_n(nearest, width, kNothing);
  for (int y = 0; y < factor; ++y) {
    const float* row = depth + static_cast<std::size_t>(y) * width;
    for (int x = 0; x < width; ++x) {
      const float z = row[x], known = z > 0 ? z : kNothing;
      nearest[x] = known < nearest[x] ? known : nearest[x];
    }
  }
  for (int j = 0; j < places; ++j) {
    const float z = *std::min_element(nearest + j * factor, nearest + (j + 1) * factor);
    smaller[j] = z < kNothing ? z : 0.f;
  }
}

}  // namespace ggslam::GGSLAM_ISA
