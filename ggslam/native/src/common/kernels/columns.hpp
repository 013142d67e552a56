// SPDX-License-Identifier: Apache-2.0
// Rows of an array as vectors of its columns, one row per lane, and back: by transposing 4 x 4 numbers at a time in
// registers. Going through memory number by number, a vector could not be read before all that it is made of is written.
#pragma once
#include <cstddef>

#include "common/kernels/simd.hpp"

namespace ggslam::GGSLAM_ISA {

// Up to kLanes rows, in ascending order, of arrays that have `count` rows; lanes from n on stand for the first one once more.
struct Rows {
  std::int32_t numbers[kLanes];
  int n;
  std::int64_t count;

  // Whether they follow one another and fill a vector: the usual case, for which addresses need not be worked out.
  bool are_run() const { return n == kLanes && numbers[kLanes - 1] - numbers[0] == kLanes - 1; }
};

// Within every four lanes: a0 b0 a1 b1 and a2 b2 a3 b3.
#if defined(__AVX512F__)
static inline Float interleave_low(Float a, Float b) {
  return (Float)_mm512_maskz_unpacklo_ps(kAll, (__m512)a, (__m512)b);
}
static inline Float interleave_high(Float a, Float b) {
  return (Float)_mm512_maskz_unpackhi_ps(kAll, (__m512)a, (__m512)b);
}
#elif defined(__AVX2__)
static inline Float interleave_low(Float a, Float b) { return (Float)_mm256_unpacklo_ps((__m256)a, (__m256)b); }
static inline Float interleave_high(Float a, Float b) { return (Float)_mm256_unpackhi_ps((__m256)a, (__m256)b); }
#elif defined(__SSE2__)
static inline Float interleave_low(Float a, Float b) { return (Float)_mm_unpacklo_ps((__m128)a, (__m128)b); }
static inline Float interleave_high(Float a, Float b) { return (Float)_mm_unpackhi_ps((__m128)a, (__m128)b); }
#else
static inline Float interleave_low(Float a, Float b) { return Float{a[0], b[0], a[1], b[1]}; }
static inline Float interleave_high(Float a, Float b) { return Float{a[2], b[2], a[3], b[3]}; }
#endif

// Within every four lanes: lane j of vector i becomes lane i of vector j.
static inline void transpose_fours(Float v[4]) {
  const Float ac_low = interleave_low(v[0], v[2]), ac_high = interleave_high(v[0], v[2]);  // a0 c0 a1 c1, a2 c2 a3 c3
  const Float bd_low = interleave_low(v[1], v[3]), bd_high = interleave_high(v[1], v[3]);
  v[0] = interleave_low(ac_low, bd_low), v[1] = interleave_high(ac_low, bd_low);
  v[2] = interleave_low(ac_high, bd_high), v[3] = interleave_high(ac_high, bd_high);
}

// Four numbers from each of rows[0], rows[4], rows[8], ...
static inline Float load_fours(const float* const* rows) {
#if defined(__AVX2__)
  const auto two = [](const float* low, const float* high) {
    return _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(low)), _mm_loadu_ps(high), 1);
  };
#if defined(__AVX512F__)
  return (Float)_mm512_maskz_insertf32x8(kAll, _mm512_castps256_ps512(two(rows[0], rows[4])), two(rows[8], rows[12]), 1);
#else
  return (Float)two(rows[0], rows[4]);
#endif
#else
  return load(rows[0]);
#endif
}

// Columns [first, first + 4) of kLanes rows, given where each row begins.
static inline void load_four_columns(const float* const* rows, Float out[4]) {
  for (int j = 0; j < 4; ++j) out[j] = load_fours(rows + j);
  transpose_fours(out);
}

// The first kWidth (3 or 4) columns of an array with `stride` columns.
template <int kWidth>
static inline void load_rows(const float* array, const Rows& rows, Float* out, int stride = kWidth) {
  static_assert(kWidth == 3 || kWidth == 4);
  const float* begins[kLanes];
  alignas(16) float last[4] = {};  // of a narrow array's last row there are no four numbers to be read
  const std::int64_t end = kWidth < 4 && stride < 4 ? rows.count - 1 : rows.count;
  Float four[4];
  if (rows.are_run() && rows.numbers[kLanes - 1] < end) {
    const float* run = array + static_cast<std::size_t>(rows.numbers[0]) * stride;
    for (int lane = 0; lane < kLanes; ++lane) begins[lane] = run + lane * stride;
    load_four_columns(begins, four);
  } else {
    for (int lane = 0; lane < kLanes; ++lane) {
      const std::int32_t row = rows.numbers[lane];
      begins[lane] = array + static_cast<std::size_t>(row) * stride;
      if (row < end) continue;
      __builtin_memcpy(last, begins[lane], sizeof(float) * kWidth);
      begins[lane] = last;
    }
    load_four_columns(begins, four);
  }
  for (int k = 0; k < kWidth; ++k) out[k] = four[k];
}

static inline Float load_column(const float* array, const Rows& rows) {
  if (rows.are_run()) return load(array + rows.numbers[0]);
  alignas(64) float values[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) values[lane] = array[rows.numbers[lane]];
  return load(values);
}

// The inverse of load_rows; lanes from n on are left out.
template <int kWidth>
static inline void store_rows(const Float* columns, float* array, const Rows& rows, int stride = kWidth) {
  static_assert(kWidth == 3 || kWidth == 4);
  Float four[4] = {};
  for (int k = 0; k < kWidth; ++k) four[k] = columns[k];
  transpose_fours(four);
  const auto write = [&](float* row, int lane) {
    const float* from = reinterpret_cast<const float*>(four + lane % 4) + lane / 4 * 4;
    __builtin_memcpy(row, from, sizeof(float) * kWidth);
  };
  if (rows.are_run()) {
    float* run = array + static_cast<std::size_t>(rows.numbers[0]) * stride;
    for (int lane = 0; lane < kLanes; ++lane) write(run + lane * stride, lane);
    return;
  }
  for (int lane = 0; lane < rows.n; ++lane) write(array + static_cast<std::size_t>(rows.numbers[lane]) * stride, lane);
}

static inline void store_column(Float column, float* array, const Rows& rows) {
  if (rows.are_run()) {
    store(array + rows.numbers[0], column);
    return;
  }
  alignas(64) float values[kLanes];
  store(values, column);
  for (int lane = 0; lane < rows.n; ++lane) array[rows.numbers[lane]] = values[lane];
}

}  // namespace ggslam::GGSLAM_ISA
