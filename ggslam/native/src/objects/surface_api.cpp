// SPDX-License-Identifier: Apache-2.0
// Entry points of what a depth image and its colours are like before regions are known.
#include <vector>

#include "objects/images.hpp"

namespace ggslam {
namespace {

// Difference of values per pixel, of `before` and `after` that are `step` pixels away from `here`.
float slope_between(float before, float here, float after, float jump, float step) {
  const float left = here - before, right = after - here;
  const float nearer = std::fabs(left) < std::fabs(right) ? left : right;
  return (std::fabs(left - right) < jump ? (left + right) / 2 : nearer) / step;
}

// The slope at a place along a row or column, at whose ends only one side is there.
float slope_at(const NormalsJob& job, const float* here, int place, int length, int along) {
  const int step = job.step;
  const float before = here[-static_cast<std::int64_t>(std::min(place, step)) * along];
  const float after = here[static_cast<std::int64_t>(std::min(length - 1 - place, step)) * along];
  const float size = static_cast<float>(step);
  if (place >= length - step) return (*here - before) / size;
  if (place < step) return (after - *here) / size;
  return slope_between(before, *here, after, job.jump, size);
}

// n . ray = 1/z (times a constant) on a plane, so the gradient of 1/z holds the first two components.
void write_normal(float gx, float gy, float inverse, const float* ray, float* normal) {
  const float z = inverse - gx * ray[0] - gy * ray[1];
  const float length = -std::max(std::sqrt(gx * gx + gy * gy + z * z), 1e-9f);
  normal[0] = gx / length, normal[1] = gy / length, normal[2] = z / length;
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_surface_normals(const ggslam::NormalsJob* job_) try {
  using namespace ggslam;
  const NormalsJob& job = object_of<NormalsJob>(job_);
  check_size(job.height, job.width);
  check_range("step", job.step, 1, kMostPixelsAlong);
  const void* const arrays[] = {job.inverse, job.rays, job.normals};
  for (const void* array : arrays) check_array("images", array, 1);
  for (int y = 0; y < job.height; ++y)
    for (int x = 0; x < job.width; ++x) {
      const std::int64_t i = static_cast<std::int64_t>(y) * job.width + x;
      const float* here = job.inverse + i;
      const float gx = slope_at(job, here, x, job.width, 1) * job.fx;
      const float gy = slope_at(job, here, y, job.height, job.width) * job.fy;
      write_normal(gx, gy, *here, row3(job.rays, i), job.normals + 3 * i);
    }
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_alike_colors(const ggslam::AlikeColorsJob* job_) try {
  using namespace ggslam;
  const AlikeColorsJob& job = object_of<AlikeColorsJob>(job_);
  check_array("colors", job.colors, job.pixels), check_array("pieces", job.pieces, job.pixels);
  check_array("asked", job.asked, job.count), check_array("means", job.means, job.count);
  check_array("alike", job.alike, job.count);
  const float square = job.limit * job.limit;
  for (std::int64_t k = 0; k < job.count; ++k) {
    const float* mean = row3(job.means, k);
    std::int64_t alike = 0;
    for (std::int64_t i = 0; i < job.pixels; ++i) {
      const float* color = row3(job.colors, i);
      const bool near = dot_differences(mean, color, mean, color) < square;
      alike += near & (job.pieces[i] != job.asked[k]);
    }
    job.alike[k] = alike;
  }
  return 0;
} GGSLAM_CATCH_ALL
