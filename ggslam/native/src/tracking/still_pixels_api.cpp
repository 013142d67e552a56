// SPDX-License-Identifier: Apache-2.0
// Entry point of what textured pixels say of whether the camera stands still. In single precision without fused products,
// so that the same pixels stay on every machine.
#include <algorithm>
#include <cmath>
#include <vector>

#include "abi/core/tracking.hpp"
#include "common/guard.hpp"

namespace ggslam {
namespace {

constexpr float kWays[4][2] = {{1.f, 0.f}, {0.7071f, 0.7071f}, {0.f, 1.f}, {-0.7071f, 0.7071f}};  // across the image

struct Planes {
  const float *smooth, *gx, *gy, *depth;

  Planes(const float* first, std::size_t count)
      : smooth(first), gx(first + count), gy(first + 2 * count), depth(first + 3 * count) {}
};

struct Comparison {
  const StillPixelsJob& job;
  Planes anchor, now;
  std::vector<int32_t> pixels;
  std::vector<uint8_t> stays;  // 0 or 1 of each

  explicit Comparison(const StillPixelsJob& job)
      : job(job), anchor(job.anchor, count_of(job)), now(job.now, count_of(job)) {}

  static std::size_t count_of(const StillPixelsJob& job) { return static_cast<std::size_t>(job.height) * job.width; }
};

// The textured pixels whose depth both images know; every so-manieth of them, if there are many.
void choose_pixels(Comparison& c) {
  const StillPixelsJob& job = c.job;
  c.pixels.resize(Comparison::count_of(job));
  std::size_t textured = 0;
  for (int32_t i = 0; i < job.height * job.width; ++i) {
    const float squared = c.anchor.gx[i] * c.anchor.gx[i] + c.anchor.gy[i] * c.anchor.gy[i];
    c.pixels[textured] = i;
    textured += (squared > job.least_squared_gradient) & (c.anchor.depth[i] > 0) & (c.now.depth[i] > 0);
  }
  const std::size_t step = std::max<std::size_t>(1, textured / job.most), count = (textured + step - 1) / step;
  for (std::size_t k = 0; k < count; ++k) c.pixels[k] = c.pixels[k * step];
  c.pixels.resize(textured < static_cast<std::size_t>(job.fewest) ? 0 : count);
}

// The middle one; the mean of the two in the middle of an even number.
float median_of(std::vector<float> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return values.size() % 2 ? *middle : (*std::max_element(values.begin(), middle) + *middle) / 2;
}

float slope_at(const Planes& anchor, int32_t i) {
  const double x = anchor.gx[i], y = anchor.gy[i];
  return static_cast<float>(std::sqrt(x * x + y * y));
}

// Notes of each pixel whether it stays, apart from a change of exposure. False if there are no numbers.
bool note_stays(Comparison& c) {
  std::vector<float> differences(c.pixels.size());
  for (std::size_t k = 0; k < c.pixels.size(); ++k) {
    differences[k] = c.now.smooth[c.pixels[k]] - c.anchor.smooth[c.pixels[k]];
    if (!std::isfinite(differences[k])) return false;
  }
  const float exposure = median_of(differences);
  c.stays.resize(c.pixels.size());
  for (std::size_t k = 0; k < c.pixels.size(); ++k)
    c.stays[k] = std::fabs(differences[k] - exposure) < c.job.largest_flow * slope_at(c.anchor, c.pixels[k]);
  return true;
}

bool is_all_over(const Comparison& c) {
  const StillPixelsJob& job = c.job;
  std::vector<int32_t> textured(job.cells * job.cells), still(textured.size());
  for (std::size_t k = 0; k < c.pixels.size(); ++k) {
    const int32_t row = c.pixels[k] / job.width, column = c.pixels[k] % job.width;
    const int32_t cell = row * job.cells / job.height * job.cells + column * job.cells / job.width;
    ++textured[cell], still[cell] += c.stays[k];
  }
  int32_t counted = 0, stay = 0;
  for (std::size_t cell = 0; cell < textured.size(); ++cell) {
    if (textured[cell] < job.fewest_in_cell) continue;
    ++counted, stay += still[cell] >= job.still_share * textured[cell];
  }
  return counted >= job.cells && stay >= job.still_cells * counted;
}

bool stays_each_way(const Comparison& c) {
  int32_t telling[4] = {}, still[4] = {};
  for (std::size_t k = 0; k < c.pixels.size(); ++k) {
    const int32_t i = c.pixels[k];
    const float slope = slope_at(c.anchor, i), x = c.anchor.gx[i] / slope, y = c.anchor.gy[i] / slope;
    for (int way = 0; way < 4; ++way)
      if (std::fabs(x * kWays[way][0] + y * kWays[way][1]) >= c.job.across) ++telling[way], still[way] += c.stays[k];
  }
  for (int way = 0; way < 4; ++way)
    if (telling[way] < c.job.fewest_across || still[way] < c.job.still_share * telling[way]) return false;
  return true;
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_still_pixels(const ggslam::StillPixelsJob* job_) try {
  using namespace ggslam;
  const StillPixelsJob& job = object_of<StillPixelsJob>(job_);
  check_range("height", job.height, 1, kMostPixelsAlong), check_range("width", job.width, 1, kMostPixelsAlong);
  check_range("fewest", job.fewest, 1, INT32_MAX), check_range("most", job.most, 1, 1 << 28);
  check_range("cells", job.cells, 1, 1 << 10);
  check_array("anchor", job.anchor, 1), check_array("now", job.now, 1), check_array("found", job.found, 1);
  Comparison comparison(job);
  choose_pixels(comparison);
  if (comparison.pixels.empty() || !note_stays(comparison)) return 0;
  if (!is_all_over(comparison) || !stays_each_way(comparison)) return 0;
  for (std::size_t k = 0; k < comparison.pixels.size(); ++k)
    job.found[k] = 2 * comparison.pixels[k] + comparison.stays[k];
  return static_cast<int>(comparison.pixels.size());
} GGSLAM_CATCH_ALL
