// SPDX-License-Identifier: Apache-2.0
// Adam (Kingma and Ba 2015) on some rows of an array and of its two moments, in place. Every row counts its own
// updates, so step size and bias correction are per row.
#pragma once
#include "rendering/rasterizer.hpp"
#include "common/kernels/columns.hpp"

namespace ggslam::GGSLAM_ISA {

// The rows that are updated together.
struct AdamRows {
  Rows rows;
  Float schedule[8];              // each row's line of AdamArguments::schedule, by columns
  const float* lines[kLanes];     // the same lines
};

static inline void count_updates(const AdamArguments& adam, const Rows& rows, AdamRows& out) {
  out.rows = rows;
  for (int i = 0; i < kLanes; ++i) {
    std::int32_t& updates = adam.updates[rows.numbers[i]];
    if (i < rows.n) updates = next_update(updates);
    out.lines[i] = adam.schedule + 8 * schedule_row(updates, adam.schedule_rows);
  }
  const float* upper[kLanes];
  for (int i = 0; i < kLanes; ++i) upper[i] = out.lines[i] + 4;
  load_four_columns(out.lines, out.schedule);
  load_four_columns(upper, out.schedule + 4);
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

// Narrow rows: the first kWidth (3 or 4) columns of an array whose rows are `stride` apart. gradients: by columns.
template <int kWidth>
static inline void adam_narrow(const AdamArguments& adam, AdamArrays arrays, int stride, const AdamRows& rows,
                               AdamGroup group, const Float* gradients) {
  Float parameters[kWidth], first[kWidth], second[kWidth];
  load_rows<kWidth>(arrays.parameters, rows.rows, parameters, stride);
  load_rows<kWidth>(arrays.first_moments, rows.rows, first, stride);
  load_rows<kWidth>(arrays.second_moments, rows.rows, second, stride);
  for (int k = 0; k < kWidth; ++k) {
    AdamVectors v{parameters[k], first[k], second[k]};
    adam_step(adam, gradients[k], rows.schedule[group], rows.schedule[kCorrection], v);
    parameters[k] = v.parameters, first[k] = v.first, second[k] = v.second;
  }
  store_rows<kWidth>(parameters, arrays.parameters, rows.rows, stride);
  store_rows<kWidth>(first, arrays.first_moments, rows.rows, stride);
  store_rows<kWidth>(second, arrays.second_moments, rows.rows, stride);
}

// Rows of one number.
static inline void adam_single(const AdamArguments& adam, AdamArrays arrays, const AdamRows& rows, AdamGroup group,
                               Float gradient) {
  AdamVectors v{load_column(arrays.parameters, rows.rows), load_column(arrays.first_moments, rows.rows),
                load_column(arrays.second_moments, rows.rows)};
  adam_step(adam, gradient, rows.schedule[group], rows.schedule[kCorrection], v);
  store_column(v.parameters, arrays.parameters, rows.rows);
  store_column(v.first, arrays.first_moments, rows.rows);
  store_column(v.second, arrays.second_moments, rows.rows);
}

// Wide rows: columns [begin, end) of an array with `stride` columns, row by row. Row i's gradients start at
// gradients + i * gradient_stride (that of column 0).
static inline void adam_wide(const AdamArguments& adam, AdamArrays arrays, int stride, int begin, int end,
                             const AdamRows& rows, AdamGroup group, const float* gradients, int gradient_stride) {
  for (int i = 0; i < rows.rows.n; ++i) {
    const std::size_t at = static_cast<std::size_t>(rows.rows.numbers[i]) * stride;
    float* parameters = arrays.parameters + at;
    float *first = arrays.first_moments + at, *second = arrays.second_moments + at;
    const float* gradient = gradients + i * gradient_stride;
    const Float step = broadcast(rows.lines[i][group]), correction = broadcast(rows.lines[i][kCorrection]);
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
