// SPDX-License-Identifier: Apache-2.0
#include "tracking/frame_images.hpp"

#include <algorithm>
#include <cmath>

namespace ggslam::GGSLAM_ISA {

int copy_depth(const float* depth, std::size_t count, float* copy) {
  int known = 0;
  for (std::size_t i = 0; i < count; ++i) {
    copy[i] = depth[i];
    known += depth[i] > 0;
  }
  return known;
}

void shrink_grey_row(const uint8_t* color, int width, int factor, uint16_t* sums, float* grey) {
  // As in OpenCV: means of two by two pixels round halves up, others to the even number; weights are in 2^-15.
  constexpr int kRed = 9798, kGreen = 19235, kBlue = 3735, kHalf = 1 << 14, kShift = 15;
  const int columns = 3 * width, places = width / factor, reach = 3 * (factor - 1);
  uint16_t* squares = sums + columns;  // sums over squares of pixels, whichever column they begin at
  std::fill_n(sums, 2 * columns, uint16_t{0});
  for (int y = 0; y < factor; ++y) {
    const uint8_t* row = color + static_cast<std::size_t>(y) * columns;
    for (int x = 0; x < columns; ++x) sums[x] = static_cast<uint16_t>(sums[x] + row[x]);
  }
  for (int off = 0; off <= reach; off += 3)
    for (int x = 0; x < columns - reach; ++x) squares[x] = static_cast<uint16_t>(squares[x] + sums[x + off]);
  const float share = 1.f / static_cast<float>(factor * factor);
  for (int j = 0; j < places; ++j) {
    int mean[3];
    for (int c = 0; c < 3; ++c) {
      const int sum = squares[3 * factor * j + c];
      mean[c] = factor == 2 ? (sum + 2) >> 2 : static_cast<int>(std::lrint(static_cast<float>(sum) * share));
    }
    grey[j] = static_cast<float>((kRed * mean[0] + kGreen * mean[1] + kBlue * mean[2] + kHalf) >> kShift);
  }
}

}  // namespace ggslam::GGSLAM_ISA
