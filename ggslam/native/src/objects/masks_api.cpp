// SPDX-License-Identifier: Apache-2.0
// Entry points of the cleaning of masks. Floats are computed in numpy's order of operations.
#include <cmath>

#include "objects/images.hpp"
#include "objects/mask_runs.hpp"

namespace ggslam {
namespace {

// Fills pixels of an image from the nearest of the others, as two passes of a chamfer distance find it: Borgefors' 5x5
// mask with weights 1, 1.4 and 2.1969 in fixed point. Of equally near ones the first in the order below counts.
class NearestFill {
 public:
  NearestFill(std::uint16_t* image, int height, int width)
      : image_(image), width_(width), stride_(width + 2 * kBorder),
        distance_(static_cast<std::size_t>(height + 2 * kBorder) * stride_, kFar) {
    for (int y = 0; y < height; ++y) std::fill_n(&distance_[padded(y, 0)], width, 0);
  }

  // `missing`: pixels in raster order.
  void fill(const std::vector<std::int32_t>& missing) {
    for (const std::int32_t pixel : missing) distance_[padded(pixel / width_, pixel % width_)] = kFar;
    for (auto pixel = missing.begin(); pixel != missing.end(); ++pixel) take_nearest(*pixel, -1);
    for (auto pixel = missing.rbegin(); pixel != missing.rend(); ++pixel) take_nearest(*pixel, 1);
  }

 private:
  static constexpr int kBorder = 2;
  static constexpr std::uint32_t kFar = 1u << 30, kStraight = 65536, kDiagonal = 91750, kLong = 143976;

  struct Step {
    int dy, dx;
    std::uint32_t length;
  };
  static constexpr Step kSteps[] = {{2, 1, kLong},     {2, -1, kLong},    {1, 2, kLong},  {1, 1, kDiagonal},
                                    {1, 0, kStraight}, {1, -1, kDiagonal}, {1, -2, kLong}, {0, 1, kStraight}};

  std::size_t padded(int y, int x) const { return static_cast<std::size_t>(y + kBorder) * stride_ + x + kBorder; }

  // From the pixels before it (`side` -1) or after it (1).
  void take_nearest(std::int32_t pixel, int side) {
    const std::size_t place = padded(pixel / width_, pixel % width_);
    std::uint32_t nearest = distance_[place];
    for (const Step& step : kSteps) {
      const std::uint32_t away = distance_[place + side * (step.dy * stride_ + step.dx)] + step.length;
      if (away >= nearest) continue;
      nearest = away, image_[pixel] = image_[pixel + side * (step.dy * width_ + step.dx)];
    }
    distance_[place] = nearest;
  }

  std::uint16_t* image_;
  std::ptrdiff_t width_, stride_;
  std::vector<std::uint32_t> distance_;
};

// The pixels of runs, those that `goes(run)`.
template <class F>
std::vector<std::int32_t> pixels_of(const MaskRuns& mask, int width, F goes) {
  std::vector<std::int32_t> pixels;
  for (int y = 0; y < mask.rows(); ++y)
    for (std::size_t k = mask.row_begin[y]; k < mask.row_begin[y + 1]; ++k)
      if (goes(k))
        for (int x = mask.runs[k].begin; x < mask.runs[k].end; ++x) pixels.push_back(y * width + x);
  return pixels;
}

std::vector<std::int32_t> find_small(const MaskRuns& mask, int width, double smallest) {
  RunPieces pieces(mask);
  std::vector<std::int64_t> size(mask.runs.size());
  for (std::size_t k = 0; k < mask.runs.size(); ++k) size[pieces.of(k)] += mask.runs[k].end - mask.runs[k].begin;
  return pixels_of(mask, width, [&](std::size_t k) { return static_cast<double>(size[pieces.of(k)]) < smallest; });
}

// Calls f(run) for runs of row y in which a pixel has nothing else around it; rows outside of the image are like those
// within.
template <class F>
void over_wide_runs(const MaskRuns& mask, int y, int width, F f) {
  const int rows[] = {std::max(y - 1, 0), y, std::min(y + 1, mask.rows() - 1)};
  std::size_t at[3];
  for (int k = 0; k < 3; ++k) at[k] = mask.row_begin[rows[k]];
  while (at[1] < mask.row_begin[y + 1]) {
    const Run &above = mask.runs[at[0]], &own = mask.runs[at[1]], &below = mask.runs[at[2]];
    const int begin = std::max({above.begin, own.begin, below.begin}), end = std::min({above.end, own.end, below.end});
    if (own.id == above.id && own.id == below.id && begin + (begin > 0) < end - (end < width)) f(at[1]);
    for (std::size_t& run : at) run += mask.runs[run].end == end;
  }
}

std::vector<std::int32_t> find_thin(const MaskRuns& mask, int width) {
  RunPieces pieces(mask);
  std::vector<std::uint8_t> wide(mask.runs.size());
  for (int y = 0; y < mask.rows(); ++y)
    over_wide_runs(mask, y, width, [&](std::size_t k) { wide[pieces.of(k)] = 1; });
  return pixels_of(mask, width, [&](std::size_t k) { return !wide[pieces.of(k)]; });
}

// Pixels within `reach` of a pixel of another id along both axes, 1.
std::vector<std::uint8_t> find_borders(const MaskRuns& mask, int width, int reach) {
  const int height = mask.rows();
  std::vector<std::uint8_t> near(static_cast<std::size_t>(height) * width);
  const auto mark = [&](int top, int bottom, int left, int right) {
    top = std::max(top, 0), bottom = std::min(bottom, height), left = std::max(left, 0), right = std::min(right, width);
    for (int y = top; y < bottom; ++y) std::fill_n(&near[static_cast<std::size_t>(y) * width + left], right - left, 1);
  };
  for (int y = 0; y < height; ++y) {
    for (std::size_t k = mask.row_begin[y] + 1; k < mask.row_begin[y + 1]; ++k)
      mark(y - reach, y + reach + 1, mask.runs[k].begin - reach, mask.runs[k].begin + reach);
    if (y + 1 < height)
      over_shared_columns(mask, y, mask, y + 1, [&](std::size_t k, std::size_t m, int begin, int end) {
        if (mask.runs[k].id != mask.runs[m].id) mark(y + 1 - reach, y + 1 + reach, begin, end);
      });
  }
  return near;
}

// Judges the pixels near borders by what lies beyond the band in eight directions.
class BorderJudge {
 public:
  BorderJudge(const TrustJob& job, const std::vector<std::uint8_t>& near) : job_(job), near_(near) {}

  bool is_trusted(int y, int x) const {
    const std::int64_t pixel = index(y, x);
    const std::uint16_t own = job_.segments[pixel];
    const float z = job_.depth[pixel], relative = job_.jump_relative * z;
    const float tolerance = relative < job_.jump_m ? job_.jump_m : relative;
    bool has_inside = false, fits_other = false;
    for (int dy = -1; dy <= 1; ++dy)
      for (int dx = -1; dx <= 1; ++dx) {
        if (dy == 0 && dx == 0) continue;
        const std::int64_t beside = shifted(y, dy, x, dx, job_.reach + 1);
        const std::uint16_t found = inside(beside);
        if (found == 0) continue;
        has_inside |= found == own;
        if (found != own && fits_other) continue;
        if (!continues(beside, shifted(y, dy, x, dx, 2 * job_.reach + 2), found, z, tolerance)) continue;
        if (found == own) return true;
        fits_other = true;
      }
    return !has_inside || !fits_other;
  }

  bool is_judged(std::int64_t pixel) const { return near_[pixel] && is_measured(pixel); }

 private:
  std::int64_t index(int y, int x) const { return static_cast<std::int64_t>(y) * job_.width + x; }

  std::int64_t shifted(int y, int dy, int x, int dx, int by) const {
    return index(std::clamp(y + by * dy, 0, job_.height - 1), std::clamp(x + by * dx, 0, job_.width - 1));
  }

  bool is_measured(std::int64_t pixel) const { return job_.segments[pixel] > 0 && job_.depth[pixel] > 0; }

  // The segment of a pixel with depth that is not near a border, else 0.
  std::uint16_t inside(std::int64_t pixel) const {
    return !near_[pixel] && is_measured(pixel) ? job_.segments[pixel] : 0;
  }

  // Whether depth z continues that of a segment, which is linear in inverse depth on a plane.
  bool continues(std::int64_t beside, std::int64_t far, std::uint16_t found, float z, float tolerance) const {
    const float depth = job_.depth[beside];
    if (std::fabs(depth - z) < tolerance) return true;
    if (inside(far) != found) return false;
    const float ahead = 2 / depth - 1 / job_.depth[far];
    return std::fabs(1 / (ahead < 1e-3f ? 1e-3f : ahead) - z) < tolerance;
  }

  const TrustJob& job_;
  const std::vector<std::uint8_t>& near_;
};

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_clean_segments(const ggslam::CleaningJob* job_) try {
  using namespace ggslam;
  const CleaningJob& job = object_of<CleaningJob>(job_);
  check_size(job.height, job.width);
  check_array("segments", job.segments, 1), check_array("cleaned", job.cleaned, 1);
  const std::size_t pixels = elements(job.height, job.width);
  std::copy_n(job.segments, pixels, job.cleaned);
  const auto fill = [&](const std::vector<std::int32_t>& missing) {
    if (missing.empty() || missing.size() == pixels) return false;
    NearestFill(job.cleaned, job.height, job.width).fill(missing);
    return true;
  };
  MaskRuns mask(job.cleaned, job.height, job.width);
  if (fill(find_small(mask, job.width, job.smallest))) mask = MaskRuns(job.cleaned, job.height, job.width);
  fill(find_thin(mask, job.width));  // only without the dots does the width of a piece show
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_trust_borders(const ggslam::TrustJob* job_) try {
  using namespace ggslam;
  const TrustJob& job = object_of<TrustJob>(job_);
  check_size(job.height, job.width);
  check_range("reach", job.reach, 1, kMostPixelsAlong);
  check_array("segments", job.segments, 1), check_array("depth", job.depth, 1), check_array("trusted", job.trusted, 1);
  const std::vector<std::uint8_t> near =
      find_borders(MaskRuns(job.segments, job.height, job.width), job.width, job.reach);
  const BorderJudge judge(job, near);
  std::int64_t pixel = 0;
  for (int y = 0; y < job.height; ++y)
    for (int x = 0; x < job.width; ++x, ++pixel)
      job.trusted[pixel] = !judge.is_judged(pixel) || judge.is_trusted(y, x);
  return 0;
} GGSLAM_CATCH_ALL
