// SPDX-License-Identifier: Apache-2.0
// Adam (Kingma and Ba 2015) on some rows of an array and of its two moments, in place. Every row counts its own
// updates, so step size and bias correction are per row.
#pragma once
#include "rendering/rasterizer.hpp"
#include "common/kernels/simd.hpp"

namespace ggslam::GGSLAM_ISA {

// The rows (at most one vector of them) that are updated together.
struct AdamRows {
  const std::int32_t* rows;
  int n;
  bool whole_run;                 // kLanes rows that follow one another: no packing needed
  bool same_count;                // all at the same update: one line of the schedule serves all
  const float* schedule[kLanes];  // each row's line of AdamArguments::schedule
};

static inline AdamRows count_updates(const AdamArguments& adam, const std::int32_t* rows, int n) {
  AdamRows result{rows, n, n == kLanes && rows[n - 1] - rows[0] == n - 1, true, {}};
  for (int i = 0; i < n; ++i) {
    const std::int32_t count = ++adam.updates[rows[i]];
    const std::int32_t line = (count < adam.schedule_rows ? count : adam.schedule_rows) - 1;
    result.schedule[i] = adam.schedule + 8 * static_cast<std::size_t>(line);
    result.same_count &= result.schedule[i] == result.schedule[0];
  }
  return result;
}

// Asks early for the cache lines of one row: there are too many arrays for the processor to foresee.
static inline __attribute__((always_inline)) void prefetch_row(const AdamArrays& arrays, std::size_t row, int width) {
  const std::size_t begin = row * static_cast<std::size_t>(width);
  for (std::size_t k = begin; k < begin + width; k += 16) {
    __builtin_prefetch(arrays.parameters + k, 1);
    __builtin_prefetch(arrays.first_moments + k, 1);
    __builtin_prefetch(arrays.second_moments + k, 1);
  }
}

struct AdamVectors {
  Float parameters, first, second;
};

static inline void adam_step(const AdamArguments& adam, Float gradient, Float step, Float correction, AdamVectors& v) {
  v.first = adam.beta1 * v.first + (1.0f - adam.beta1) * gradient;
  v.second = adam.beta2 * v.second + (1.0f - adam.beta2) * gradient * gradient;
  v.parameters -= step * v.first / (square_root(v.second) * correction + adam.epsilon);
}

// Adam on kWidth * kLanes numbers, kWidth per row, side by side.
template <int kWidth>
static inline void adam_packed(const AdamArguments& adam, const AdamRows& rows, AdamGroup group, const float* gradients,
                               AdamArrays packed) {
  alignas(64) float step[kWidth * kLanes], correction[kWidth * kLanes];
  if (!rows.same_count) {
    for (int i = 0; i < kWidth * kLanes; ++i) {
      const float* line = rows.schedule[i / kWidth < rows.n ? i / kWidth : 0];
      step[i] = line[group], correction[i] = line[kCorrection];
    }
  }
  const Float same_step = broadcast(rows.schedule[0][group]);
  const Float same_correction = broadcast(rows.schedule[0][kCorrection]);
  for (int i = 0; i < kWidth * kLanes; i += kLanes) {
    AdamVectors v{load(packed.parameters + i), load(packed.first_moments + i), load(packed.second_moments + i)};
    adam_step(adam, load(gradients + i), rows.same_count ? same_step : load(step + i),
              rows.same_count ? same_correction : load(correction + i), v);
    store(packed.parameters + i, v.parameters);
    store(packed.first_moments + i, v.first);
    store(packed.second_moments + i, v.second);
  }
}

template <int kWidth>
static inline void pack(const AdamRows& rows, const float* array, std::size_t stride, float* packed) {
  for (int i = 0; i < kLanes; ++i)  // lanes from n on repeat row 0 and are not written back
    for (int k = 0; k < kWidth; ++k) packed[i * kWidth + k] = array[rows.rows[i < rows.n ? i : 0] * stride + k];
}

template <int kWidth>
static inline void unpack(const AdamRows& rows, const float* packed, std::size_t stride, float* array) {
  for (int i = 0; i < rows.n; ++i)
    for (int k = 0; k < kWidth; ++k) array[rows.rows[i] * stride + k] = packed[i * kWidth + k];
}

// Narrow rows: the first kWidth columns of an array whose rows are `stride` apart. gradients [kLanes][kWidth].
template <int kWidth>
static inline void adam_narrow(const AdamArguments& adam, AdamArrays arrays, std::size_t stride, const AdamRows& rows,
                               AdamGroup group, const float* gradients) {
  if (rows.whole_run && stride == kWidth) {
    const std::size_t at = rows.rows[0] * stride;
    const AdamArrays run{arrays.parameters + at, arrays.first_moments + at, arrays.second_moments + at};
    return adam_packed<kWidth>(adam, rows, group, gradients, run);
  }
  alignas(64) float parameters[kWidth * kLanes], first[kWidth * kLanes], second[kWidth * kLanes];
  pack<kWidth>(rows, arrays.parameters, stride, parameters);
  pack<kWidth>(rows, arrays.first_moments, stride, first);
  pack<kWidth>(rows, arrays.second_moments, stride, second);
  adam_packed<kWidth>(adam, rows, group, gradients, {parameters, first, second});
  unpack<kWidth>(rows, parameters, stride, arrays.parameters);
  unpack<kWidth>(rows, first, stride, arrays.first_moments);
  unpack<kWidth>(rows, second, stride, arrays.second_moments);
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
