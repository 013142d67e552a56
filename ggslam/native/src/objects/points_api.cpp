// SPDX-License-Identifier: Apache-2.0
// Entry points of where the segments of a keyframe lie. Sums are added up in raster order and in numpy's order of
// operations.
#include <limits>
#include <vector>

#include "common/vector.hpp"
#include "native/formulas/symmetric3.hpp"
#include "objects/images.hpp"

namespace ggslam {
namespace {

Vec3d point_at(const SegmentedDepth& image, int y, int x) {
  const double z = image.depth[static_cast<std::int64_t>(y) * image.width + x];
  return {{image.rays_x[x] * z, image.rays_y[y] * z, z}};
}

void check_segment(const SegmentedDepth& image, std::int32_t segment) {
  if (segment < -1 || segment >= image.segments_end)
    refuse("row: expected segments below %d, found %d", image.segments_end, segment);
}

// Neighbouring pixels of a row that have one segment, which is the k-th of those asked.
struct SegmentRun {
  std::int32_t y, begin, end, k;
};

std::vector<SegmentRun> find_runs(const SegmentedDepth& image, const std::int32_t* asked, std::int32_t count) {
  std::vector<std::int32_t> place(image.segments_end + 1, -1);  // of segment -1, 0, 1 ... among those asked
  for (std::int32_t k = 0; k < count; ++k) place[asked[k] + 1] = k;
  std::vector<SegmentRun> runs;
  const std::int32_t* row = image.row;
  for (int y = 0; y < image.height; ++y, row += image.width)
    for (int begin = 0, end; begin < image.width; begin = end) {
      for (end = begin + 1; end < image.width && row[end] == row[begin];) ++end;
      check_segment(image, row[begin]);
      const std::int32_t k = place[row[begin] + 1];
      if (k >= 0) runs.push_back({y, begin, end, k});
    }
  return runs;
}

void check_image(const SegmentedDepth& image, const std::int32_t* asked, std::int32_t count) {
  check_size(image.height, image.width);
  const void* const arrays[] = {image.row, image.depth, image.rays_x, image.rays_y};
  for (const void* array : arrays) check_array("image", array, 1);
  check_range("segments", image.segments_end, 0, std::numeric_limits<std::int32_t>::max() - 1);
  check_numbers("asked", asked, count, image.segments_end);
}

// Every `stride`-th point of an image along each axis, those of a segment beside each other, in raster order.
class SegmentPoints {
 public:
  SegmentPoints(const SegmentedDepth& image, int stride) : begin_(image.segments_end + 2) {
    const auto over_seen = [&](auto f) {
      for (int y = 0; y < image.height; y += stride)
        for (int x = 0; x < image.width; x += stride) {
          const std::int64_t pixel = static_cast<std::int64_t>(y) * image.width + x;
          check_segment(image, image.row[pixel]);
          const float z = image.depth[pixel];
          if (z > 0 && z < std::numeric_limits<float>::infinity()) f(image.row[pixel] + 1, y, x);
        }
    };
    over_seen([&](std::int32_t place, int, int) { ++begin_[place + 1]; });
    for (std::size_t k = 1; k < begin_.size(); ++k) begin_[k] += begin_[k - 1];
    points_.resize(begin_.back());
    std::vector<std::size_t> next(begin_);
    over_seen([&](std::int32_t place, int y, int x) { points_[next[place]++] = point_at(image, y, x); });
  }

  const std::vector<Vec3d>& all() const { return points_; }
  const Vec3d* begin(std::int32_t segment) const { return points_.data() + begin_[segment + 1]; }
  std::size_t count(std::int32_t segment) const { return begin_[segment + 2] - begin_[segment + 1]; }

 private:
  std::vector<std::size_t> begin_;  // of segment -1, 0, 1 ...
  std::vector<Vec3d> points_;
};

// Fits a plane to most of the points of a segment: that of all of them, and twice of those near the one before.
class PlaneFit {
 public:
  PlaneFit(const Vec3d* points, std::size_t count) : points_(points), count_(count), near_(count, 1), away_(count) {
    for (int turn = 0; turn < 3 && is_found_; ++turn) {
      if (turn > 0) keep_near();
      fit();
    }
  }

  bool is_found() const { return is_found_; }
  const Vec3d& centre() const { return centre_; }
  const Vec3d& normal() const { return normal_; }

  double share_within(double flat_m) const {
    std::size_t within = 0;
    for (std::size_t i = 0; i < count_; ++i) within += away_[i] < flat_m * std::max(1.0, points_[i][2] / 3);
    return static_cast<double>(within) / static_cast<double>(count_);
  }

 private:
  static constexpr std::size_t kLeast = 10;  // points
  static constexpr double kLeastNear = 1e-3;  // metres; what is nearer to a plane lies on it

  void fit() {
    Vec3d sum{};
    std::size_t near = 0;
    for (std::size_t i = 0; i < count_; ++i)
      if (near_[i]) sum = sum + points_[i], ++near;
    is_found_ = near >= kLeast;
    if (!is_found_) return;
    centre_ = sum / static_cast<double>(near);
    double moments[6] = {}, values[3], axes[3][3];
    for (std::size_t i = 0; i < count_; ++i) {
      if (!near_[i]) continue;
      const Vec3d d = points_[i] - centre_;
      for (int a = 0, k = 0; a < 3; ++a)
        for (int b = a; b < 3; ++b, ++k) moments[k] += d[a] * d[b];
    }
    plain::eigen_symmetric3(moments, 0, values, axes);
    normal_ = {{axes[2][0], axes[2][1], axes[2][2]}};
    for (std::size_t i = 0; i < count_; ++i) away_[i] = std::fabs(dot(points_[i] - centre_, normal_));
  }

  // Points within three times the median distance.
  void keep_near() {
    sorted_ = away_;
    const auto middle = sorted_.begin() + static_cast<std::ptrdiff_t>(count_ / 2);
    std::nth_element(sorted_.begin(), middle, sorted_.end());
    const double median = count_ % 2 ? *middle : (*std::max_element(sorted_.begin(), middle) + *middle) / 2;
    const double limit = std::max(3 * median, kLeastNear);
    for (std::size_t i = 0; i < count_; ++i) near_[i] = away_[i] <= limit;
  }

  const Vec3d* points_;
  std::size_t count_;
  std::vector<std::uint8_t> near_;
  std::vector<double> away_, sorted_;
  bool is_found_ = true;
  Vec3d centre_{}, normal_{};
};

SegmentPlane plane_of(const SegmentPoints& points, std::int32_t segment, const SegmentPlanesJob& job) {
  SegmentPlane plane{};
  const Vec3d* own = points.begin(segment);
  const std::size_t count = points.count(segment);
  const PlaneFit fit(own, count);
  if (!fit.is_found() || fit.share_within(job.flat_m) < job.min_on_plane) return plane;
  const Vec3d normal = dot(fit.normal(), fit.centre()) > 0 ? -1.0 * fit.normal() : fit.normal();
  plane.is_flat = 1;
  plane.offset = dot(normal, fit.centre());
  normal.to(plane.normal);
  Vec3d sum{};
  for (std::size_t i = 0; i < count; ++i) sum = sum + own[i];
  (sum / static_cast<double>(count)).to(plane.middle);
  std::size_t behind = 0;
  for (const Vec3d& p : points.all())
    behind += dot(p, normal) - plane.offset < -job.behind_m * std::max(1.0, p[2] / 2);
  plane.behind = static_cast<double>(behind) / static_cast<double>(points.all().size());
  return plane;
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_segment_extents(const ggslam::ExtentsJob* job_) try {
  using namespace ggslam;
  const ExtentsJob& job = object_of<ExtentsJob>(job_);
  check_image(job.image, job.asked, job.count);
  check_array("centres", job.centres, job.count), check_array("squares", job.squares, job.count);
  if (job.count == 0) return 0;
  const std::vector<SegmentRun> runs = find_runs(job.image, job.asked, job.count);
  // Adds f(point) for the points of a run to a sum.
  const auto add_up = [&](const SegmentRun& run, auto& total, auto f) {
    const float* depth = job.image.depth + static_cast<std::int64_t>(run.y) * job.image.width;
    auto sum = total;  // in registers
    for (int x = run.begin; x < run.end; ++x)
      if (depth[x] > 0) sum = sum + f(point_at(job.image, run.y, x));
    total = sum;
  };
  std::vector<Vec3d> centre(job.count, Vec3d{});
  std::vector<double> count(job.count), square(job.count);
  for (const SegmentRun& run : runs) {
    add_up(run, count[run.k], [](const Vec3d&) { return 1.0; });
    add_up(run, centre[run.k], [](const Vec3d& point) { return point; });
  }
  for (std::int32_t k = 0; k < job.count; ++k) centre[k] = centre[k] / std::max(count[k], 1.0);
  for (const SegmentRun& run : runs)
    add_up(run, square[run.k], [c = centre[run.k]](const Vec3d& point) { return dot(point - c, point - c); });
  for (std::int32_t k = 0; k < job.count; ++k) {
    centre[k].to(job.centres + 3 * k);
    job.squares[k] = square[k] / std::max(count[k], 1.0);
  }
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_segment_planes(const ggslam::SegmentPlanesJob* job_) try {
  using namespace ggslam;
  const SegmentPlanesJob& job = object_of<SegmentPlanesJob>(job_);
  check_image(job.image, job.asked, job.count);
  check_range("stride", job.stride, 1, kMostPixelsAlong);
  check_array("planes", job.planes, job.count);
  const SegmentPoints points(job.image, job.stride);
  for (std::int32_t k = 0; k < job.count; ++k) job.planes[k] = plane_of(points, job.asked[k], job);
  return 0;
} GGSLAM_CATCH_ALL
