// SPDX-License-Identifier: Apache-2.0
// Points of a depth image on a grid of pixels, with normals and covariances from their neighbours in the image.
#include "native/formulas/depth_window.hpp"
#include "tracking/tracking_types.hpp"

namespace ggslam::GGSLAM_ISA {

// Writes the points of one grid row (image row v) to the front of `out`; returns their number.
int depth_points_row(const float* depth, const DepthPointsSettings& s, int v, const DepthPointsOutput& out) {
  const int border = s.window * s.window_step;
  int n = 0;
  for (int u = border + s.stride / 2; u < s.width - border; u += s.stride) {
    const float z = depth[v * s.width + u];
    if (!(z >= s.min_depth && z <= s.max_depth)) continue;
    float scatter[6];
    if (!window_scatter(depth, s, u, v, z, scatter)) continue;
    out.weights[n] = describe_point(s, u, v, z, scatter, out.points + 3 * n, out.normals + 3 * n, out.covariances + 6 * n);
    out.pixels[2 * n] = u, out.pixels[2 * n + 1] = v;
    ++n;
  }
  return n;
}

}  // namespace ggslam::GGSLAM_ISA
