// SPDX-License-Identifier: Apache-2.0
// Vectors of the small integers that voxels hold, and of pixels looked up one by one.
#pragma once
#include <cstring>

#include "common/kernels/simd.hpp"

namespace ggslam::GGSLAM_ISA {

typedef std::int16_t Short __attribute__((vector_size(2 * kLanes), aligned(2), may_alias));
typedef std::uint16_t UnsignedShort __attribute__((vector_size(2 * kLanes), aligned(2), may_alias));
typedef std::uint8_t Byte __attribute__((vector_size(kLanes), aligned(1), may_alias));

static inline Int load_widened(const std::int16_t* p) {
  return __builtin_convertvector(*reinterpret_cast<const Short*>(p), Int);
}
static inline Int load_widened(const std::uint16_t* p) {
  return __builtin_convertvector(*reinterpret_cast<const UnsignedShort*>(p), Int);
}
static inline Int load_widened(const std::uint8_t* p) {
#if defined(__AVX512F__)
  return (Int)_mm512_cvtepu8_epi32(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p)));
#elif defined(__AVX2__)
  return (Int)_mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(p)));
#else
  return __builtin_convertvector(*reinterpret_cast<const Byte*>(p), Int);
#endif
}
// The values must be in range.
static inline void store_narrowed(std::int16_t* p, Int v) {
#if defined(__AVX2__) && !defined(__AVX512F__)
  const __m256i w = (__m256i)v;
  _mm_storeu_si128(reinterpret_cast<__m128i*>(p),
                   _mm_packs_epi32(_mm256_castsi256_si128(w), _mm256_extracti128_si256(w, 1)));
#else
  *reinterpret_cast<Short*>(p) = __builtin_convertvector(v, Short);
#endif
}
static inline void store_narrowed(std::uint16_t* p, Int v) {
#if defined(__AVX2__) && !defined(__AVX512F__)
  const __m256i w = (__m256i)v;
  _mm_storeu_si128(reinterpret_cast<__m128i*>(p),
                   _mm_packus_epi32(_mm256_castsi256_si128(w), _mm256_extracti128_si256(w, 1)));
#else
  *reinterpret_cast<UnsignedShort*>(p) = __builtin_convertvector(v, UnsignedShort);
#endif
}
static inline void store_narrowed(std::uint8_t* p, Int v) {
#if defined(__AVX2__) && !defined(__AVX512F__)
  const __m256i w = (__m256i)v;
  const __m128i words = _mm_packus_epi32(_mm256_castsi256_si128(w), _mm256_extracti128_si256(w, 1));
  _mm_storel_epi64(reinterpret_cast<__m128i*>(p), _mm_packus_epi16(words, words));
#else
  *reinterpret_cast<Byte*>(p) = __builtin_convertvector(v, Byte);
#endif
}

static inline Int gather_int(const std::int32_t* p, Int at) {
#if defined(__AVX512F__)
  return (Int)_mm512_i32gather_epi32((__m512i)at, p, 4);
#elif defined(__AVX2__)
  // About a tenth faster than the gather instruction on Zen 3.
  const __m128i low = _mm256_castsi256_si128((__m256i)at), high = _mm256_extracti128_si256((__m256i)at, 1);
  const std::uint64_t a = _mm_cvtsi128_si64(low), b = _mm_extract_epi64(low, 1), c = _mm_cvtsi128_si64(high),
                      d = _mm_extract_epi64(high, 1);
  const auto pair = [p](std::uint64_t two) {
    return _mm_insert_epi32(_mm_cvtsi32_si128(p[static_cast<std::uint32_t>(two)]), p[two >> 32], 1);
  };
  const __m128i first = _mm_unpacklo_epi64(pair(a), pair(b)), second = _mm_unpacklo_epi64(pair(c), pair(d));
  return (Int)_mm256_inserti128_si256(_mm256_castsi128_si256(first), second, 1);
#else
  Int v{};
  for (int lane = 0; lane < kLanes; ++lane) v[lane] = p[at[lane]];
  return v;
#endif
}
static inline Float gather(const float* p, Int at) {
  return (Float)gather_int(reinterpret_cast<const std::int32_t*>(p), at);
}

// p[at] and p[at + 1].
static inline void gather_pairs(const float* p, Int at, Float& first, Float& second) {
#if defined(__AVX2__) && !defined(__AVX512F__)
  alignas(32) std::int32_t place[kLanes];
  *reinterpret_cast<Int*>(place) = at;
  const auto two = [p, &place](int lane) {
    const __m128 low = _mm_castsi128_ps(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(p + place[lane])));
    return _mm_loadh_pi(low, reinterpret_cast<const __m64*>(p + place[lane + 1]));
  };
  const __m256 a = _mm256_insertf128_ps(_mm256_castps128_ps256(two(0)), two(4), 1);
  const __m256 b = _mm256_insertf128_ps(_mm256_castps128_ps256(two(2)), two(6), 1);
  first = (Float)_mm256_shuffle_ps(a, b, 0x88), second = (Float)_mm256_shuffle_ps(a, b, 0xDD);
#else
  first = gather(p, at), second = gather(p + 1, at);
#endif
}

static inline Mask neither_of(Mask a, Mask b) { return both(a, Mask(~b)); }  // a without b

}  // namespace ggslam::GGSLAM_ISA
