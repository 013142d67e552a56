// SPDX-License-Identifier: Apache-2.0
// Entry point of depth at reduced size.
#include <vector>

#include "common/guard.hpp"
#include "sight/places.hpp"

GGSLAM_EXPORT int ggslam_shrink_depth(const float* depth, int32_t height, int32_t width, int32_t factor,
                                      float* smaller) try {
  using namespace ggslam;
  check_range("height", height, 1, kMostPixelsAlong), check_range("width", width, 1, kMostPixelsAlong);
  check_range("factor", factor, 1, height < width ? height : width);
  check_array("depth", depth, 1), check_array("smaller", smaller, 1);
  static const auto shrink = GGSLAM_DISPATCH(best_isa(), shrink_depth_row);
  const std::size_t places = width / factor;
  std::vector<float> nearest(width);
  for (int row = 0; row < height / factor; ++row)
    shrink(depth + static_cast<std::size_t>(row) * factor * width, width, factor, nearest.data(), smaller + row * places);
  return 0;
} GGSLAM_CATCH_ALL
