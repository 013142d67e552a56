// SPDX-License-Identifier: Apache-2.0
// Squared distances to the nearest occupied cell, one axis after the other; what is farther than the reach stays there.
#include <algorithm>
#include <cstddef>
#include <cstdint>

namespace ggslam::GGSLAM_ISA {
namespace {

// From a cell's centre to a cell's nearest face, `steps` cells away.
inline float gap(int steps) { return steps == 0 ? 0.0f : static_cast<float>(steps) - 0.5f; }

}  // namespace

// Along x: `width` cells, 1 where they are occupied.
void distances_along_line(const uint8_t* occupied, int width, int reach, float* squared) {
  int since = reach + 1;
  for (int x = 0; x < width; ++x) {
    since = occupied[x] ? 0 : std::min(since + 1, reach + 1);
    squared[x] = static_cast<float>(since);
  }
  since = reach + 1;
  for (int x = width - 1; x >= 0; --x) {
    since = occupied[x] ? 0 : std::min(since + 1, reach + 1);
    const float steps = std::min(static_cast<float>(since), squared[x]), d = steps > 0 ? steps - 0.5f : 0.0f;
    squared[x] = d * d;
  }
}

// Across lines of `width` cells: the lines of `count`, `stride` cells apart; the result of line `own` goes to `out`.
void distances_across_lines(const float* squared, std::ptrdiff_t stride, int count, int own, int width, int reach,
                            float* out) {
  const int first = std::max(0, own - reach), last = std::min(count - 1, own + reach);
  std::copy_n(squared + own * stride, width, out);
  for (int line = first; line <= last; ++line) {
    const float d = gap(line < own ? own - line : line - own), more = d * d;
    const float* from = squared + line * stride;
    for (int x = 0; x < width; ++x) out[x] = std::min(out[x], from[x] + more);
  }
}

}  // namespace ggslam::GGSLAM_ISA
