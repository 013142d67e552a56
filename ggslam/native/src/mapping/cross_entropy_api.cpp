// SPDX-License-Identifier: Apache-2.0
// Entry point of the cross-entropy of pixels: parts handed to threads, sums added up in the order of the parts.
#include <algorithm>
#include <limits>
#include <vector>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "mapping/cross_entropy.hpp"

namespace ggslam {
namespace {

std::int64_t check_and_count(const CrossEntropyOfPixels& job) {
  check_range("channels", job.channels, 1, kMostEntropyChannels);
  check_range("count", job.count, 0, 1 << 16);
  const std::int64_t values = static_cast<std::int64_t>(elements(job.pixels, job.channels)), rows = job.count;
  check_array("features", job.features, values), check_array("d_features", job.d_features, values);
  check_array("classes", job.classes, job.pixels);
  check_array("weight", job.weight, rows), check_array("bias", job.bias, rows), check_array("d_rows", job.d_rows, rows);
  std::int64_t counted = 0;
  for (std::int64_t p = 0; p < job.pixels; ++p) {
    check_range("classes", job.classes[p], -1, job.count - 1);
    counted += job.classes[p] >= 0;
  }
  return counted;
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_cross_entropy_of_pixels(void* context, ggslam::CrossEntropyOfPixels* pointer) try {
  using namespace ggslam;
  Context& c = object_of<Context>(context);
  CrossEntropyOfPixels& job = object_of<CrossEntropyOfPixels>(pointer);
  const std::int64_t counted = check_and_count(job);
  const std::size_t parts = static_cast<std::size_t>((job.pixels + kEntropyPixels - 1) / kEntropyPixels);
  const std::size_t size = elements(job.count, job.channels + 1), scratch = entropy_logit_floats(job.count) + 16;
  std::vector<float> rows(elements(static_cast<std::int64_t>(parts), static_cast<std::int64_t>(size)), 0.f);
  std::vector<float> logits(static_cast<std::size_t>(c.pool.size()) * scratch);
  std::vector<double> losses(parts, 0.0);
  const float share = counted > 0 ? 1.0f / static_cast<float>(counted) : 0.0f;
  const auto add = GGSLAM_DISPATCH(c.isa, cross_entropy_part);
  c.pool.parallel_for(parts, 1, [&](std::size_t part, std::size_t, int thread) {
    const std::int64_t begin = static_cast<std::int64_t>(part) * kEntropyPixels;
    float* own = logits.data() + thread * scratch;
    own += (64 - reinterpret_cast<std::uintptr_t>(own) % 64) % 64 / sizeof(float);
    losses[part] = add(job, begin, std::min(job.pixels, begin + kEntropyPixels), share, own, rows.data() + part * size);
  });
  job.loss = 0;
  if (size > 0) std::fill_n(job.d_rows, size, 0.f);
  for (std::size_t part = 0; part < parts; ++part) {
    job.loss += losses[part];
    for (std::size_t i = 0; i < size; ++i) job.d_rows[i] += rows[part * size + i];
  }
  if (counted > 0) job.loss /= static_cast<double>(counted);
  return 0;
} GGSLAM_CATCH_ALL
