// SPDX-License-Identifier: Apache-2.0
#include "rendering/mesh_picture.hpp"

#include <algorithm>
#include <cmath>

namespace ggslam::GGSLAM_ISA {
namespace {

// Twice the signed area of a triangle in the image; negative where it is counter-clockwise as seen (rows run down).
float doubled_area(const ProjectedVertex& a, const ProjectedVertex& b, float u, float v) {
  return (b.u - a.u) * (v - a.v) - (b.v - a.v) * (u - a.u);
}

}  // namespace

void mesh_picture_project(const MeshPictureInput& in, std::size_t begin, std::size_t end, ProjectedVertex* out) {
  for (std::size_t n = begin; n < end; ++n) {
    const float* p = in.positions + 3 * n;
    const float inverse = p[2] > in.near ? 1 / p[2] : 0;
    out[n] = {in.fx * p[0] * inverse + in.cx, in.fy * p[1] * inverse + in.cy, inverse};
  }
}

// Draws rows [top, bottom). `inverse_z` [height, width] holds the inverse depth of what is drawn, 0 where nothing is.
void mesh_picture_band(const MeshPictureInput& in, const ProjectedVertex* vertices, int top, int bottom,
                       float* inverse_z, uint8_t* picture) {
  for (int64_t t = 0; t < in.count; ++t) {
    const int32_t* rows = in.triangles + 3 * t;
    const ProjectedVertex &a = vertices[rows[0]], &b = vertices[rows[1]], &c = vertices[rows[2]];
    const float low = std::min(a.v, std::min(b.v, c.v)), high = std::max(a.v, std::max(b.v, c.v));
    if (high < top || low > bottom - 1) continue;
    if (a.inverse_z == 0 || b.inverse_z == 0 || c.inverse_z == 0) continue;
    const float area = doubled_area(a, b, c.u, c.v);
    if (area == 0 || (in.cull && area > 0)) continue;
    const float left = std::min(a.u, std::min(b.u, c.u)), right = std::max(a.u, std::max(b.u, c.u));
    if (right < 0 || left > in.width - 1) continue;
    const int first = static_cast<int>(std::ceil(std::max(left, 0.0f)));
    const int last = static_cast<int>(std::floor(std::min(right, in.width - 1.0f)));
    const int begin = static_cast<int>(std::ceil(std::max(low, static_cast<float>(top))));
    const int end = static_cast<int>(std::floor(std::min(high, bottom - 1.0f)));
    for (int v = begin; v <= end; ++v)
      for (int u = first; u <= last; ++u) {
        // Shares of the corners in the image; inverse depth is linear there.
        const float wa = doubled_area(b, c, u, v) / area, wb = doubled_area(c, a, u, v) / area, wc = 1 - wa - wb;
        if (wa < 0 || wb < 0 || wc < 0) continue;
        const float inverse = wa * a.inverse_z + wb * b.inverse_z + wc * c.inverse_z;
        const std::size_t pixel = static_cast<std::size_t>(v) * in.width + u;
        if (inverse <= inverse_z[pixel]) continue;
        inverse_z[pixel] = inverse;
        for (int k = 0; k < 3; ++k) {
          const float mixed = wa * a.inverse_z * in.colors[3 * rows[0] + k] +
                              wb * b.inverse_z * in.colors[3 * rows[1] + k] +
                              wc * c.inverse_z * in.colors[3 * rows[2] + k];
          picture[3 * pixel + k] = static_cast<uint8_t>(std::min(mixed / inverse + 0.5f, 255.0f));
        }
      }
  }
}

}  // namespace ggslam::GGSLAM_ISA
