// SPDX-License-Identifier: Apache-2.0
// Entry points of colours that depend on the view: Gaussians handed to threads, and their equations solved.
#include "mapping/view_colors.hpp"

#include <cmath>

#include "common/context.hpp"
#include "common/guard.hpp"

namespace ggslam {
namespace {

constexpr std::size_t kGaussiansAtOnce = 1024;

void check_count(int count) {
  if (count != 3 && count != 8 && count != kMostViewColors) refuse("count: expected 3, 8 or 15, found %d", count);
}

void check_job(const ViewColorsOfView& job) {
  check_count(job.count);
  check_range("stride", job.stride, 3, 48);
  const auto values = static_cast<std::int64_t>(elements(job.gaussians, job.stride));
  check_array("weights", job.weights, values), check_array("residuals", job.residuals, values);
  check_array("means", job.means, job.gaussians), check_array("equations", job.equations, job.gaussians);
  check_within("centre", job.centre, 3, 1e9);
}

// Solves (A + ridge I) x = b for three right sides in place; returns the sum of x b. A is the lower triangle, which its
// Cholesky factor replaces.
float solve(float* equation, int n, float ridge) {
  double factor[kMostViewColors][kMostViewColors];
  const float* a = equation;
  for (int i = 0; i < n; ++i)
    for (int j = 0; j <= i; ++j) {
      double sum = *a++ + (i == j ? ridge : 0.f);
      for (int k = 0; k < j; ++k) sum -= factor[i][k] * factor[j][k];
      factor[i][j] = i == j ? std::sqrt(sum) : sum / factor[j][j];  // at least the root of the ridge, but for rounding
    }
  float* right = equation + n * (n + 1) / 2;
  double gain = 0;
  for (int c = 0; c < 3; ++c) {
    double x[kMostViewColors];
    for (int i = 0; i < n; ++i) {
      x[i] = right[3 * i + c];
      for (int k = 0; k < i; ++k) x[i] -= factor[i][k] * x[k];
      x[i] /= factor[i][i];
      gain += x[i] * x[i];
    }
    for (int i = n - 1; i >= 0; --i) {
      for (int k = i + 1; k < n; ++k) x[i] -= factor[k][i] * x[k];
      x[i] /= factor[i][i];
      right[3 * i + c] = static_cast<float>(x[i]);
    }
  }
  return static_cast<float>(gain);
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_view_colors_add(void* context_, const ggslam::ViewColorsOfView* pointer) try {
  using namespace ggslam;
  Context& context = object_of<Context>(context_);
  const ViewColorsOfView& job = object_of<ViewColorsOfView>(pointer);
  check_job(job);
  const auto add = GGSLAM_DISPATCH(context.isa, view_colors_add);
  context.pool.parallel_for(static_cast<std::size_t>(job.gaussians), kGaussiansAtOnce,
                            [&](std::size_t begin, std::size_t end, int) {
                              add(job, static_cast<std::int64_t>(begin), static_cast<std::int64_t>(end));
                            });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_view_colors_solve(void* context_, float* equations, int64_t gaussians, int count, float ridge,
                                           float* gains) try {
  using namespace ggslam;
  Context& context = object_of<Context>(context_);
  check_count(count);
  if (!(ridge > 0)) refuse("ridge: expected a number above 0, found %g", static_cast<double>(ridge));
  check_array("equations", equations, gaussians), check_array("gains", gains, gaussians);
  const int floats = view_color_floats(count);
  context.pool.parallel_for(static_cast<std::size_t>(gaussians), kGaussiansAtOnce,
                            [&](std::size_t begin, std::size_t end, int) {
                              for (std::size_t i = begin; i < end; ++i) gains[i] = solve(equations + i * floats, count, ridge);
                            });
  return 0;
} GGSLAM_CATCH_ALL
