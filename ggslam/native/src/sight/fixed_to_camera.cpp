// SPDX-License-Identifier: Apache-2.0
// Entry point of what views of one camera say of what is fixed to it.
#include <cmath>

#include "common/guard.hpp"
#include "sight/places.hpp"

namespace ggslam {
namespace {

constexpr double kNearest = 1e-3;  // metres before the camera, where a place falls on the image

struct Motion {
  double R[9], t[3];
};

// From the camera at one pose, rows of [R t], to that at another.
Motion motion_between(const double* T_world_from, const double* T_world_to) {
  Motion motion;
  for (int i = 0; i < 3; ++i) {
    motion.t[i] = 0;
    for (int j = 0; j < 3; ++j) motion.R[3 * i + j] = 0;
    for (int k = 0; k < 3; ++k) {
      const double* from = T_world_from + 4 * k;
      const double along = T_world_to[4 * k + i];
      motion.t[i] += along * (from[3] - T_world_to[4 * k + 3]);
      for (int j = 0; j < 3; ++j) motion.R[3 * i + j] += along * from[j];
    }
  }
  return motion;
}

bool is_near(const SightMargin& margin, double own, double z) {
  return own > 0 && std::fabs(own - z) <= margin_at(margin, z, 1.0);
}

bool is_beyond(const SightMargin& margin, double own, double z) {
  return own > 0 && own > z && !is_near(margin, own, z);
}

// Counts what another view says of each pixel of one.
void compare(const FixedToCameraJob& job, const float* depth, const float* other, const Motion& motion) {
  const std::size_t count = static_cast<std::size_t>(job.height) * static_cast<std::size_t>(job.width);
  const auto fx = static_cast<float>(job.fx), fy = static_cast<float>(job.fy);
  const auto cx = static_cast<float>(job.cx), cy = static_cast<float>(job.cy);
  const double* R = motion.R;
  for (std::size_t i = 0; i < count; ++i) {
    const float d = depth[i];
    if (!(d > 0)) continue;
    const int row = static_cast<int>(i) / job.width, column = static_cast<int>(i) % job.width;
    const double p[] = {(static_cast<float>(column) - cx) / fx * d, (static_cast<float>(row) - cy) / fy * d, d};
    const double x = R[0] * p[0] + R[1] * p[1] + R[2] * p[2] + motion.t[0];
    const double y = R[3] * p[0] + R[4] * p[1] + R[5] * p[2] + motion.t[1];
    const double z = R[6] * p[0] + R[7] * p[1] + R[8] * p[2] + motion.t[2];
    const double ahead = z > kNearest ? z : kNearest;
    const double shift = std::hypot(job.fx * x / ahead + job.cx - column, job.fy * y / ahead + job.cy - row);
    if (!(shift > job.least_shift)) continue;
    const double u = std::nearbyint(job.fx * x / z + job.cx), v = std::nearbyint(job.fy * y / z + job.cy);
    const bool inside = z > 0 && u >= 0 && v >= 0 && u < job.width && v < job.height;
    const double there = inside ? other[static_cast<std::size_t>(v) * job.width + static_cast<std::size_t>(u)] : 0.0;
    const bool still = is_near(job.same, other[i], d);
    job.counts[i] += still && is_beyond(job.past, there, z);
    job.counts[count + i] += still;
    job.counts[2 * count + i] += is_near(job.same, there, z);
  }
}

void check_view(const LocatedDepth& view) {
  check_array("depth", view.depth, 1);
  check_within("T_world_camera", view.T_world_camera, 12, 1e9);
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_fixed_to_camera(const ggslam::FixedToCameraJob* job_) try {
  using namespace ggslam;
  const FixedToCameraJob& job = object_of<FixedToCameraJob>(job_);
  check_camera(job.width, job.height, job.fx, job.fy, job.cx, job.cy);
  check_margin(job.same), check_margin(job.past);
  check_array("earlier", job.earlier, job.count), check_array("counts", job.counts, 1);
  check_view(job.newest);
  for (int i = 0; i < job.count; ++i) check_view(job.earlier[i]);
  for (int i = 0; i < job.count; ++i) {
    const LocatedDepth &newest = job.newest, &earlier = job.earlier[i];
    compare(job, newest.depth, earlier.depth, motion_between(newest.T_world_camera, earlier.T_world_camera));
    compare(job, earlier.depth, newest.depth, motion_between(earlier.T_world_camera, newest.T_world_camera));
  }
  return 0;
} GGSLAM_CATCH_ALL
