// SPDX-License-Identifier: Apache-2.0
// Entry points of what views say of places: rows, views and points handed to threads, and how much depths of one
// surface differ.
#include <algorithm>
#include <cmath>
#include <vector>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "sight/places.hpp"

namespace ggslam {

void check_margin(const SightMargin& margin) {
  const double numbers[] = {margin.least, margin.share, margin.sigmas, margin.constant, margin.square};
  for (const double number : numbers) check_range("margin", number, 0.0, 1e9);
}

void check_rule(const PlacesRule& rule) {
  check_margin(rule.margin), check_range("every", rule.every, 1, 1 << 20);
}

void check_view(const char* name, const PlacesView& view) {
  check_range(name, view.height, 1, kMostPixelsAlong), check_range(name, view.width, 1, kMostPixelsAlong);
  const float numbers[] = {view.fx, view.fy, view.cx, view.cy};
  check_within(name, numbers, 4, 1e7);
  const void* const arrays[] = {view.depth, view.near, view.far, view.whole, view.smooth};
  for (const void* array : arrays) check_array(name, array, 1);
}

namespace {

constexpr std::size_t kRows = 4, kPoints = 4096;  // handed out at once
constexpr float kNormal = 0.6745f;  // the median of a normal distribution's absolute values

// How far depth at a place of the other view, between its four pixels, is from that of the point there.
float off_by(const SightMargin& margin, const PlacesView& other, float u, float v, float z) {
  const int left = std::clamp(static_cast<int>(u), 0, std::max(0, other.width - 2));
  const int top = std::clamp(static_cast<int>(v), 0, std::max(0, other.height - 2));
  const int right = std::min(left + 1, other.width - 1), low = std::min(top + 1, other.height - 1);
  const float a = u - static_cast<float>(left), b = v - static_cast<float>(top);
  const float* upper_row = other.depth + static_cast<std::size_t>(top) * other.width;
  const float* lower_row = other.depth + static_cast<std::size_t>(low) * other.width;
  const float upper = (1 - a) * upper_row[left] + a * upper_row[right];
  const float lower = (1 - a) * lower_row[left] + a * lower_row[right];
  return std::fabs((1 - b) * upper + b * lower - z) / sigma_at(margin, z);
}

}  // namespace

float measured_share(const PlacesRule& rule, const uint8_t* moved, const PlacesView& other,
                     const ProjectedPlaces& places, std::size_t count) {
  std::vector<float> off;
  int seen = 0;
  for (std::size_t i = 0; i < count; ++i) {
    if (!places.smooth[i] || (moved != nullptr && moved[i])) continue;
    if (seen++ % rule.every == 0) off.push_back(off_by(rule.margin, other, places.u[i], places.v[i], places.z[i]));
  }
  if (off.empty() || off.size() < static_cast<std::size_t>(rule.fewest)) return rule.rough;
  const auto middle = off.begin() + static_cast<std::ptrdiff_t>(off.size() / 2);
  std::nth_element(off.begin(), middle, off.end());
  float median = *middle;
  if (off.size() % 2 == 0) median = (median + *std::max_element(off.begin(), middle)) / 2;
  return std::clamp(rule.nearest * median / kNormal, rule.least_share, rule.rough);
}

}  // namespace ggslam

GGSLAM_EXPORT int ggslam_depth_places(void* context_, const ggslam::DepthPlacesJob* job_) try {
  using namespace ggslam;
  Context& context = object_of<Context>(context_);
  const DepthPlacesJob& job = object_of<DepthPlacesJob>(job_);
  check_range("height", job.height, 1, kMostPixelsAlong), check_range("width", job.width, 1, kMostPixelsAlong);
  check_range("factor", job.factor, 1, std::min(job.height, job.width));
  check_range("reach", job.reach, 0, kMostPixelsAlong);
  const void* const arrays[] = {job.depth, job.nearest, job.farthest, job.least, job.count, job.total, job.squares};
  for (const void* array : arrays) check_array("images", array, 1);
  const std::size_t width = static_cast<std::size_t>(job.width), threads = static_cast<std::size_t>(context.pool.size());
  std::vector<double> sums(2 * width * threads);
  std::vector<float> bounds(4 * width * threads);
  const auto row_kernel = GGSLAM_DISPATCH(context.isa, depth_places_row);
  const std::size_t rows = static_cast<std::size_t>(job.height / job.factor);
  context.pool.parallel_for(rows, kRows, [&](std::size_t begin, std::size_t end, int thread) {
    double* s = sums.data() + 2 * width * static_cast<std::size_t>(thread);
    float* b = bounds.data() + 4 * width * static_cast<std::size_t>(thread);
    const DepthColumns columns{s, s + width, b, b + width, b + 2 * width, b + 3 * width};
    for (std::size_t row = begin; row < end; ++row) row_kernel(job, static_cast<int>(row), columns);
  });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_places_evidence(void* context_, const ggslam::PlacesEvidenceJob* job_) try {
  using namespace ggslam;
  Context& context = object_of<Context>(context_);
  const PlacesEvidenceJob& job = object_of<PlacesEvidenceJob>(job_);
  check_view("view", job.view), check_rule(job.rule);
  check_array("others", job.others, job.count), check_array("found", job.found, job.count);
  for (int i = 0; i < job.count; ++i) {
    check_view("other view", job.others[i].places);
    check_within("T_this_view", job.others[i].T_this_view, 12, 1e9);
  }
  const std::size_t count = static_cast<std::size_t>(job.view.width) * static_cast<std::size_t>(job.view.height);
  const auto project = GGSLAM_DISPATCH(context.isa, project_places);
  const auto look_up = GGSLAM_DISPATCH(context.isa, look_up_places);
  const auto judge = GGSLAM_DISPATCH(context.isa, judge_places);
  std::vector<PlacesScratch> scratch(static_cast<std::size_t>(context.pool.size()));
  context.pool.parallel_for(static_cast<std::size_t>(job.count), 1, [&](std::size_t i, std::size_t, int thread) {
    const ProjectedPlaces places = scratch[static_cast<std::size_t>(thread)].places(count);
    project(job.view, job.others[i], places), look_up(job.view, job.others[i].places, places);
    const float share = measured_share(job.rule, job.moved, job.others[i].places, places, count);
    judge(job.rule, share, count, places, job.found + 5 * count * i);
  });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_sight(void* context_, const ggslam::SightJob* job_) try {
  using namespace ggslam;
  Context& context = object_of<Context>(context_);
  const SightJob& job = object_of<SightJob>(job_);
  check_camera(job.width, job.height, job.fx, job.fy, job.cx, job.cy), check_margin(job.margin);
  check_within("T_camera_world", job.T_camera_world, 12, 1e9);
  const void* const images[] = {job.depth, job.near, job.far};
  for (const void* image : images) check_array("images", image, 1);
  const void* const results[] = {job.codes, job.pixels, job.z};
  for (const void* result : results) check_array("results", result, job.count);
  if (job.points == nullptr) {
    const std::int64_t pixels = std::int64_t{job.height} * job.width;
    check_range("count", job.count, pixels, pixels), check_array("depths", job.depths, job.count);
  }
  const auto classify = GGSLAM_DISPATCH(context.isa, classify_places);
  context.pool.parallel_for(elements(job.count), kPoints, [&](std::size_t begin, std::size_t end, int) {
    classify(job, begin, end);
  });
  return 0;
} GGSLAM_CATCH_ALL
