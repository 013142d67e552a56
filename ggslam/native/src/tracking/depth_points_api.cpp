// SPDX-License-Identifier: Apache-2.0
#include <cstring>
#include <vector>

#include "common/context.hpp"
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
                                      const ggslam::DepthPointsOutput* out) {
  using namespace ggslam;
  Context& context = *static_cast<Context*>(context_);
  const DepthPointsSettings& s = *settings;
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
}
