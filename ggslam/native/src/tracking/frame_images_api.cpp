// SPDX-License-Identifier: Apache-2.0
#include "tracking/frame_images.hpp"

#include <vector>

#include "common/guard.hpp"

GGSLAM_EXPORT int64_t ggslam_copy_depth(const float* depth, int64_t count, float* copy) try {
  using namespace ggslam;
  check_range<int64_t>("count", count, 0, int64_t{kMostPixelsAlong} * kMostPixelsAlong);
  check_array("depth", depth, count), check_array("copy", copy, count);
  static const auto kernel = GGSLAM_DISPATCH(best_isa(), copy_depth);
  return kernel(depth, static_cast<std::size_t>(count), copy);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_shrink_grey(const uint8_t* color, int32_t height, int32_t width, int32_t factor,
                                     float* grey) try {
  using namespace ggslam;
  check_range("height", height, 1, kMostPixelsAlong), check_range("width", width, 1, kMostPixelsAlong);
  check_range("factor", factor, 1, 16);  // sums of more would not fit
  if (height % factor != 0 || width % factor != 0)
    refuse("factor: expected a divisor of %d and %d, found %d", height, width, factor);
  check_array("color", color, 1), check_array("grey", grey, 1);
  static const auto kernel = GGSLAM_DISPATCH(best_isa(), shrink_grey_row);
  std::vector<uint16_t> sums(6 * static_cast<std::size_t>(width));
  for (int row = 0; row < height / factor; ++row)
    kernel(color + 3 * static_cast<std::size_t>(row) * factor * width, width, factor, sums.data(),
           grey + static_cast<std::size_t>(row) * (width / factor));
  return 0;
} GGSLAM_CATCH_ALL
