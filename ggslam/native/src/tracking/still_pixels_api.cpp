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

// The textured pixels whose depth both images know; every so-manieth of them, if there are many.
std::vector<int32_t> choose_pixels(const StillPixelsJob& job) {
  std::vector<int32_t> found(static_cast<std::size_t>(job.height) * job.width);
  std::size_t textured = 0;
  for (int32_t i = 0; i < job.height * job.width; ++i) {
    const float squared = job.gx[i] * job.gx[i] + job.gy[i] * job.gy[i];
    found[textured] = i;
    textured += (squared > job.least_squared_gradient) & (job.depth[i] > 0) & (job.depth_now[i] > 0);
  }
  if (textured < static_cast<std::size_t>(job.fewest)) return {};
  const std::size_t step = std::max<std::size_t>(1, textured / job.most), count = (textured + step - 1) / step;
  for (std::size_t k = 0; k < count; ++k) found[k] = found[k * step];
  found.resize(count);
  return found;
}

// The middle one; the mean of the two in the middle of an even number.
float median_of(std::vector<float> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return values.size() % 2 ? *middle : (*std::max_element(values.begin(), middle) + *middle) / 2;
}

float slope_at(const StillPixelsJob& job, int32_t i) {
  const double x = job.gx[i], y = job.gy[i];
  return static_cast<float>(std::sqrt(x * x + y * y));
}

// Notes of each pixel whether it stays, apart from a change of exposure. False if there are no numbers.
bool note_stays(const StillPixelsJob& job, const std::vector<int32_t>& pixels) {
  std::vector<float> differences(pixels.size());
  for (std::size_t k = 0; k < pixels.size(); ++k) {
    differences[k] = job.smooth_now[pixels[k]] - job.smooth[pixels[k]];
    if (!std::isfinite(differences[k])) return false;
  }
  const float exposure = median_of(differences);
  for (std::size_t k = 0; k < pixels.size(); ++k)
    job.stays[k] = std::fabs(differences[k] - exposure) < job.largest_flow * slope_at(job, pixels[k]);
  return true;
}

bool is_all_over(const StillPixelsJob& job, const std::vector<int32_t>& pixels) {
  std::vector<int32_t> textured(job.cells * job.cells), still(textured.size());
  for (std::size_t k = 0; k < pixels.size(); ++k) {
    const int32_t row = pixels[k] / job.width, column = pixels[k] % job.width;
    const int32_t cell = row * job.cells / job.height * job.cells + column * job.cells / job.width;
    ++textured[cell], still[cell] += job.stays[k];
  }
  int32_t counted = 0, stay = 0;
  for (std::size_t cell = 0; cell < textured.size(); ++cell) {
    if (textured[cell] < job.fewest_in_cell) continue;
    ++counted, stay += still[cell] >= job.still_share * textured[cell];
  }
  return counted >= job.cells && stay >= job.still_cells * counted;
}

bool stays_each_way(const StillPixelsJob& job, const std::vector<int32_t>& pixels) {
  int32_t telling[4] = {}, still[4] = {};
  for (std::size_t k = 0; k < pixels.size(); ++k) {
    const float slope = slope_at(job, pixels[k]), x = job.gx[pixels[k]] / slope, y = job.gy[pixels[k]] / slope;
    for (int way = 0; way < 4; ++way)
      if (std::fabs(x * kWays[way][0] + y * kWays[way][1]) >= job.across) ++telling[way], still[way] += job.stays[k];
  }
  for (int way = 0; way < 4; ++way)
    if (telling[way] < job.fewest_across || still[way] < job.still_share * telling[way]) return false;
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
  for (const float* image : {job.smooth, job.gx, job.gy, job.depth, job.smooth_now, job.depth_now})
    check_array("image", image, 1);
  check_array("pixels", job.pixels, 1), check_array("stays", job.stays, 1);
  const std::vector<int32_t> pixels = choose_pixels(job);
  if (pixels.empty() || !note_stays(job, pixels)) return 0;
  std::copy(pixels.begin(), pixels.end(), job.pixels);
  return is_all_over(job, pixels) && stays_each_way(job, pixels) ? static_cast<int>(pixels.size()) : 0;
} GGSLAM_CATCH_ALL
