// SPDX-License-Identifier: Apache-2.0
// Adam (Kingma and Ba 2015) on some rows of an array and of its two moments, in place. Every row counts its own
// updates, so step size and bias correction are per row.
#pragma once
#include "rasterizer.hpp"
#include "simd.hpp"

namespace ggslam::GGSLAM_ISA {

// The rows (at most one vector of them) that are updated together.
struct AdamRows {
  const std::int32_t* rows;
  int n;
  const float* schedule[kLanes];  // each row's line of AdamArguments::schedule
};

static inline AdamRows count_updates(const AdamArguments& adam, const std::int32_t* rows, int n) {
  AdamRows result{rows, n, {}};
  for (int i = 0; i < n; ++i) {
    const std::int32_t count = ++adam.updates[rows[i]];
    const std::int32_t line = (count < adam.schedule_rows ? count : adam.schedule_rows) - 1;
    result.schedule[i] = adam.schedule + 8 * static_cast<std::size_t>(line);
  }
  return result;
}

struct AdamVectors {
  Float parameters, first, second;
};

static inline void adam_step(const AdamArguments& adam, Float gradient, Float step, Float correction, AdamVectors& v) {
  v.first = adam.beta1 * v.first + (1.0f - adam.beta1) * gradient;
  v.second = adam.beta2 * v.second + (1.0f - adam.beta2) * gradient * gradient;
  v.parameters -= step * v.first / (square_root(v.second) * correction + adam.epsilon);
}

// Narrow rows: kWidth columns of an array whose rows are `stride` apart. gradients [n][kWidth]. The rows are packed
// side by side, so that the vectors are full.
template <int kWidth>
static inline void adam_narrow(const AdamArguments& adam, AdamArrays arrays, std::size_t stride, const AdamRows& rows,
                               AdamGroup group, const float* gradients) {
  constexpr int kSize = kWidth * kLanes;
  alignas(64) float p[kSize], first[kSize], second[kSize], step[kSize], correction[kSize];
  for (int i = 0; i < kLanes; ++i) {
    const int row = i < rows.n ? i : 0;  // lanes from n on repeat row 0 and are not written back
    const std::size_t at = rows.rows[row] * stride;
    for (int k = 0; k < kWidth; ++k) {
      p[i * kWidth + k] = arrays.parameters[at + k];
      first[i * kWidth + k] = arrays.first_moments[at + k];
      second[i * kWidth + k] = arrays.second_moments[at + k];
      step[i * kWidth + k] = rows.schedule[row][group];
      correction[i * kWidth + k] = rows.schedule[row][kCorrection];
    }
  }
  for (int i = 0; i < kSize; i += kLanes) {
    AdamVectors v{load(p + i), load(first + i), load(second + i)};
    adam_step(adam, load(gradients + i), load(step + i), load(correction + i), v);
    store(p + i, v.parameters), store(first + i, v.first), store(second + i, v.second);
  }
  for (int i = 0; i < rows.n; ++i) {
    const std::size_t at = rows.rows[i] * stride;
    for (int k = 0; k < kWidth; ++k) {
      arrays.parameters[at + k] = p[i * kWidth + k];
      arrays.first_moments[at + k] = first[i * kWidth + k];
      arrays.second_moments[at + k] = second[i * kWidth + k];
    }
  }
}

// Wide rows: columns [begin, end) of an array with `stride` columns, row by row. Row i's gradients start at
// gradients + i * gradient_stride (that of column 0).
static inline void adam_wide(const AdamArguments& adam, AdamArrays arrays, int stride, int begin, int end,
                             const AdamRows& rows, AdamGroup group, const float* gradients, int gradient_stride) {
  for (int i = 0; i < rows.n; ++i) {
    const std::size_t at = static_cast<std::size_t>(rows.rows[i]) * stride;
    float* parameters = arrays.parameters + at;
    float *first = arrays.first_moments + at, *second = arrays.second_moments + at;
    const float* gradient = gradients + i * gradient_stride;
    const Float step = broadcast(rows.schedule[i][group]), correction = broadcast(rows.schedule[i][kCorrection]);
    int k = begin;
    for (; k + kLanes <= end; k += kLanes) {
      AdamVectors v{load(parameters + k), load(first + k), load(second + k)};
      adam_step(adam, load(gradient + k), step, correction, v);
      store(parameters + k, v.parameters), store(first + k, v.first), store(second + k, v.second);
    }
    if (k == end) continue;
    alignas(64) float rest[4][kLanes] = {};
    for (int j = 0; j < end - k; ++j) {
      rest[0][j] = parameters[k + j], rest[1][j] = first[k + j], rest[2][j] = second[k + j];
      rest[3][j] = gradient[k + j];
    }
    AdamVectors v{load(rest[0]), load(rest[1]), load(rest[2])};
    adam_step(adam, load(rest[3]), step, correction, v);
    store(rest[0], v.parameters), store(rest[1], v.first), store(rest[2], v.second);
    for (int j = 0; j < end - k; ++j) {
      parameters[k + j] = rest[0][j], first[k + j] = rest[1][j], second[k + j] = rest[2][j];
    }
  }
}

}  // namespace ggslam::GGSLAM_ISA
