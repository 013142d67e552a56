// SPDX-License-Identifier: Apache-2.0
// A depth image's places, a row at a time: sums down the columns first, then along the row.
#include <algorithm>
#include <limits>

#include "sight/places.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

constexpr float kNothing = std::numeric_limits<float>::infinity();

void sum_window(const DepthPlacesJob& job, int middle, const DepthColumns& c) {
  const int width = job.width;
  std::fill_n(c.total, width, 0.0), std::fill_n(c.squares, width, 0.0), std::fill_n(c.count, width, 0.f);
  for (int y = middle - job.reach; y <= middle + job.reach; ++y) {
    const float* depth = job.depth + static_cast<std::size_t>(mirrored(y, job.height)) * width;
    for (int x = 0; x < width; ++x) {
      const float z = depth[x];
      c.total[x] += z;
      c.squares[x] += z * z;
      c.count[x] += z > 0 ? 1.f : 0.f;
    }
  }
}

void bound_block(const DepthPlacesJob& job, int row, const DepthColumns& c) {
  const int width = job.width;
  std::fill_n(c.nearest, width, kNothing), std::fill_n(c.farthest, width, -kNothing);
  std::fill_n(c.least, width, kNothing);
  for (int y = row * job.factor; y < (row + 1) * job.factor; ++y) {
    const float* depth = job.depth + static_cast<std::size_t>(y) * width;
    for (int x = 0; x < width; ++x) {
      const float z = depth[x], known = z > 0 ? z : kNothing;
      c.nearest[x] = known < c.nearest[x] ? known : c.nearest[x];
      c.farthest[x] = z > c.farthest[x] ? z : c.farthest[x];
      c.least[x] = z < c.least[x] ? z : c.least[x];
    }
  }
}

}  // namespace

void depth_places_row(const DepthPlacesJob& job, int row, const DepthColumns& c) {
  const int factor = job.factor, places = job.width / factor;
  const std::size_t first = static_cast<std::size_t>(row) * places;
  sum_window(job, row * factor + factor / 2, c);
  bound_block(job, row, c);
  for (int j = 0; j < places; ++j) {
    const int middle = j * factor + factor / 2;
    double total = 0, squares = 0;
    float count = 0, nearest = kNothing, farthest = -kNothing, least = kNothing;
    for (int x = middle - job.reach; x <= middle + job.reach; ++x) {
      const int at = x >= 0 && x < job.width ? x : mirrored(x, job.width);
      total += c.total[at], squares += c.squares[at], count += c.count[at];
    }
    for (int x = j * factor; x < (j + 1) * factor; ++x) {
      nearest = std::min(nearest, c.nearest[x]);
      farthest = std::max(farthest, c.farthest[x]);
      least = std::min(least, c.least[x]);
    }
    job.nearest[first + j] = nearest, job.farthest[first + j] = farthest, job.least[first + j] = least;
    job.count[first + j] = count;
    job.total[first + j] = static_cast<float>(total), job.squares[first + j] = static_cast<float>(squares);
  }
}

}  // namespace ggslam::GGSLAM_ISA
