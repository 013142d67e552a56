// SPDX-License-Identifier: Apache-2.0
// What one view says of points of the world, or of depths at its own pixels.
#include <cmath>

#include "sight/places.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

uint8_t judge(const SightJob& job, std::size_t pixel, double z) {
  const double own = job.depth[pixel], near = job.near[pixel], far = job.far[pixel];
  if (!(own > 0)) return kUnknown;
  const double within = margin_at(job.margin, z, 1.0);
  if (std::fabs(own - z) <= within) return kSame;
  if (own > z) return near > z + within ? kThrough : kBefore;
  return near > 0 && far < z - within ? kHidden : kBehind;
}

}  // namespace

void classify_places(const SightJob& job, std::size_t begin, std::size_t end) {
  const double* T = job.T_camera_world;
  for (std::size_t i = begin; i < end; ++i) {
    job.pixels[i] = 0, job.codes[i] = kOutside;
    if (job.points == nullptr) {
      job.z[i] = job.depths[i];
      if (!(job.z[i] > 0)) continue;
      job.pixels[i] = static_cast<int32_t>(i);
    } else {
      const double* p = job.points + 3 * i;
      const double x = T[0] * p[0] + T[1] * p[1] + T[2] * p[2] + T[3];
      const double y = T[4] * p[0] + T[5] * p[1] + T[6] * p[2] + T[7];
      const double z = job.z[i] = T[8] * p[0] + T[9] * p[1] + T[10] * p[2] + T[11];
      const double column = std::nearbyint(job.fx * x / z + job.cx), row = std::nearbyint(job.fy * y / z + job.cy);
      const bool inside = z > 0 && column >= 0 && row >= 0 && column < job.width && row < job.height;
      if (!inside) continue;  // what is not a number is not inside either
      job.pixels[i] = static_cast<int32_t>(row) * job.width + static_cast<int32_t>(column);
    }
    job.codes[i] = judge(job, static_cast<std::size_t>(job.pixels[i]), job.z[i]);
  }
}

}  // namespace ggslam::GGSLAM_ISA
