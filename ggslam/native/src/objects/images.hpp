// SPDX-License-Identifier: Apache-2.0
// Pixels of a depth image, and the links between neighbours. These passes follow numpy's order of operations: compiled
// once, without fused products, they find what the tests' reference finds on every processor.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "common/guard.hpp"
#include "abi/core/objects.hpp"

namespace ggslam {

// The links of an image along its rows (to the right) or its columns (downwards).
struct LinkAxis {
  int width;          // of the image
  int rows, columns;  // of the links
  int along;          // pixels between neighbours, as an index of the image steps
  bool down;

  static LinkAxis right_of(int height, int width) { return {width, height, width - 1, 1, false}; }
  static LinkAxis below_of(int height, int width) { return {width, height - 1, width, width, true}; }

  std::int64_t pixel(int y, int x) const { return static_cast<std::int64_t>(y) * width + x; }
  std::int64_t link(int y, int x) const { return static_cast<std::int64_t>(y) * columns + x; }
  int place(int y, int x) const { return down ? y : x; }   // along the axis
  int length() const { return down ? rows + 1 : columns + 1; }
  // A pixel so many farther along the axis, or the last in the image.
  std::int64_t shifted(std::int64_t pixel, int place, int by) const {
    return pixel + static_cast<std::int64_t>(std::clamp(place + by, 0, length() - 1) - place) * along;
  }
};

// f(axis) for both axes.
template <class F>
void over_axes(int height, int width, F f) {
  f(LinkAxis::right_of(height, width));
  f(LinkAxis::below_of(height, width));
}

inline const float* row3(const float* rows, std::int64_t i) { return rows + 3 * i; }

inline float dot3(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// (b - a) . (d - c)
inline float dot_differences(const float* a, const float* b, const float* c, const float* d) {
  return (b[0] - a[0]) * (d[0] - c[0]) + (b[1] - a[1]) * (d[1] - c[1]) + (b[2] - a[2]) * (d[2] - c[2]);
}

// Metres that separate surfaces.
inline float gap_at(const SegmentedSurface& s, std::int64_t pixel) {
  return s.gap_m + s.gap_sigmas * (s.sigma * (s.depth[pixel] * s.depth[pixel]));
}

// Metres that a surface may fall off from pixel to pixel, steep as it may be.
inline float steepest_step(float gap, float depth) {
  constexpr float kSteepest = 0.02f;  // share of the depth
  return 4 * gap + kSteepest * depth;
}

inline void check_size(int height, int width) {
  check_range("height", height, 1, kMostPixelsAlong);
  check_range("width", width, 1, kMostPixelsAlong);
}

inline void check_surface(const SegmentedSurface& s) {
  check_size(s.height, s.width);
  check_range("step", s.step, 1, kMostPixelsAlong);
  const void* const arrays[] = {s.valid, s.depth, s.inverse, s.points, s.normals};
  for (const void* array : arrays) check_array("surface", array, 1);
}

inline void check_links(const char* name, const PixelLinks& links, int height, int width) {
  check_array(name, links.right, static_cast<std::int64_t>(height) * (width - 1));
  check_array(name, links.below, static_cast<std::int64_t>(height - 1) * width);
}

// Numbers that index tables.
inline void check_numbers(const char* name, const std::int32_t* values, std::int64_t count, std::int32_t end) {
  check_array(name, values, count);
  for (std::int64_t i = 0; i < count; ++i)
    if (values[i] < 0 || values[i] >= end) refuse("%s: expected numbers from 0 to %d, found %d", name, end - 1, values[i]);
}

}  // namespace ggslam
