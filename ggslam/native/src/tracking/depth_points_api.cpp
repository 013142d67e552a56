// SPDX-License-Identifier: Apache-2.0
#include <cstring>
#include <vector>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "tracking/tracking_types.hpp"

GGSLAM_DECLARE_KERNEL(int depth_points_row(const float* depth, const DepthPointsSettings& settings, int v,
                                           const DepthPointsOutput& out))

namespace ggslam {
namespace {

DepthPointsOutput advanced(const DepthPointsOutput& o, std::size_t n) {
  return {o.points + 3 * n, o.normals + 3 * n, o.covariances + 6 * n, o.pixels + 2 * n, o.weights + n};
}

void move_rows(const DepthPointsOutput& to, const DepthPointsOutput& from, std::size_t n) {
  std::memmove(to.points, from.points, 3 * n * sizeof(float));
  std::memmove(to.normals, from.normals, 3 * n * sizeof(float));
  std::memmove(to.covariances, from.covariances, 6 * n * sizeof(float));
  std::memmove(to.pixels, from.pixels, 2 * n * sizeof(int32_t));
  std::memmove(to.weights, from.weights, n * sizeof(float));
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_depth_points(void* context_, const float* depth, const ggslam::DepthPointsSettings* settings,
                                      const ggslam::DepthPointsOutput* out) try {
  using namespace ggslam;
  Context& context = object_of<Context>(context_);
  const DepthPointsSettings& s = object_of<DepthPointsSettings>(settings);
  check_range("width", s.width, 1, kMostPixelsAlong), check_range("height", s.height, 1, kMostPixelsAlong);
  check_range("stride", s.stride, 1, kMostPixelsAlong);
  check_range("window", s.window, 0, 1 << 10), check_range("window_step", s.window_step, 1, 1 << 10);
  check_array("depth", depth, 1);
  const DepthPointsOutput& to = object_of<DepthPointsOutput>(out);
  const void* const arrays[] = {to.points, to.normals, to.covariances, to.pixels, to.weights};
  for (const void* array : arrays) check_array("out", array, 1);
  const auto row_kernel = GGSLAM_DISPATCH(context.isa, depth_points_row);
  const int border = s.window * s.window_step, first = border + s.stride / 2;
  const int rows = first < s.height - border ? (s.height - border - first + s.stride - 1) / s.stride : 0;
  const std::size_t columns = (s.width + s.stride - 1) / s.stride;
  std::vector<int> counts(rows);
  context.pool.parallel_for(rows, 8, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t r = begin; r < end; ++r)
      counts[r] = row_kernel(depth, s, first + static_cast<int>(r) * s.stride, advanced(*out, r * columns));
  });
  std::size_t total = 0;
  for (int r = 0; r < rows; ++r) {
    move_rows(advanced(*out, total), advanced(*out, r * columns), counts[r]);
    total += counts[r];
  }
  return static_cast<int>(total);
} GGSLAM_CATCH_ALL
