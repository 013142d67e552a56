// SPDX-License-Identifier: Apache-2.0
// Entry points of insertion: rows handed to threads, the pixels chosen in each brought together.
#include "mapping/insertion.hpp"

#include <algorithm>
#include <memory>
#include <vector>

#include "common/context.hpp"
#include "common/guard.hpp"

namespace ggslam {
namespace {

constexpr std::size_t kRowsAtOnce = 16, kGaussiansAtOnce = 256;

void check_job(const InsertionJob& job) {
  check_range("height", job.height, 1, kMostPixelsAlong);
  check_range("width", job.width, 1, kMostPixelsAlong);
  const float camera[] = {job.fx, job.fy, job.cx, job.cy};
  check_within("camera", camera, 4, 1e9);
  const void* const arrays[] = {job.color, job.depth, job.marks, job.pixels};
  for (const void* array : arrays) check_array("images", array, 1);
}

std::int64_t select(Context& context, InsertionJob& job) {
  const std::size_t height = job.height, width = job.width;
  const std::unique_ptr<uint8_t[]> grey(new uint8_t[height * width]), bits(new uint8_t[height * width]);
  const auto make_grey = GGSLAM_DISPATCH(context.isa, insertion_grey);
  const auto find_bits = GGSLAM_DISPATCH(context.isa, insertion_bits);
  const auto choose = GGSLAM_DISPATCH(context.isa, insertion_choose);
  if (job.adaptive_stride)
    context.pool.parallel_for(height, kRowsAtOnce, [&](std::size_t begin, std::size_t end, int) {
      make_grey(job, grey.get(), static_cast<int>(begin), static_cast<int>(end));
    });
  context.pool.parallel_for(height, kRowsAtOnce, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t y = begin; y < end; ++y) find_bits(job, grey.get(), bits.get(), static_cast<int>(y));
  });
  std::vector<int> counts(height);
  context.pool.parallel_for(height, kRowsAtOnce, [&](std::size_t begin, std::size_t end, int) {
    const std::unique_ptr<uint8_t[]> scratch(new uint8_t[2 * (width + 4)]);
    for (std::size_t y = begin; y < end; ++y)
      counts[y] = choose(job, bits.get(), static_cast<int>(y), scratch.get(), job.pixels + y * width);
  });
  std::int64_t total = 0;
  for (std::size_t y = 0; y < height; ++y) {
    const int64_t* found = job.pixels + y * width;
    if (total != static_cast<std::int64_t>(y * width)) std::copy(found, found + counts[y], job.pixels + total);
    total += counts[y];
  }
  return total;
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int64_t ggslam_insertion_select(void* context, ggslam::InsertionJob* job) try {
  using namespace ggslam;
  check_job(object_of<InsertionJob>(job));
  return select(object_of<Context>(context), *job);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_insertion_shape(void* context_, const ggslam::InsertionJob* job_, int64_t count) try {
  using namespace ggslam;
  Context& context = object_of<Context>(context_);
  const InsertionJob& job = object_of<InsertionJob>(job_);
  check_job(job);
  const void* const results[] = {job.means, job.quaternions, job.log_scales, job.rgb};
  for (const void* result : results) check_array("results", result, count);
  check_range<std::int64_t>("count", count, 0, static_cast<std::int64_t>(job.height) * job.width);
  const auto shape = GGSLAM_DISPATCH(context.isa, insertion_shape);
  context.pool.parallel_for(static_cast<std::size_t>(count), kGaussiansAtOnce,
                            [&](std::size_t begin, std::size_t end, int) {
                              shape(job, static_cast<std::int64_t>(begin), static_cast<std::int64_t>(end));
                            });
  return 0;
} GGSLAM_CATCH_ALL
