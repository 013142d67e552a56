// SPDX-License-Identifier: Apache-2.0
// One vector type for all instruction sets: Float and Int of kLanes = 16 (AVX-512), 8 (AVX2) or 4 (SSE2, NEON) lanes,
// a Mask of comparisons, and the few operations that plain operators (+ - * / & | << >>, vector with vector or scalar)
// do not give. Built on the vector extensions of GCC and Clang; intrinsics only where those compile badly.
//
// Everything here is `static inline`: each translation unit keeps its own copy, so the linker can never replace the
// code of one instruction set by that of another.
#pragma once
#include <cstdint>
#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

namespace ggslam::GGSLAM_ISA {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float Float __attribute__((vector_size(4 * kLanes), aligned(4 * kLanes), may_alias));
typedef std::int32_t Int __attribute__((vector_size(4 * kLanes), aligned(4 * kLanes), may_alias));
typedef std::uint32_t Bits __attribute__((vector_size(4 * kLanes), aligned(4 * kLanes), may_alias));
typedef float UnalignedFloat __attribute__((vector_size(4 * kLanes), aligned(4), may_alias));
typedef std::int32_t UnalignedInt __attribute__((vector_size(4 * kLanes), aligned(4), may_alias));

static inline Float broadcast(float x) { return x - Float{}; }
static inline Int broadcast_int(std::int32_t x) { return x - Int{}; }
static inline Float load(const float* p) { return *reinterpret_cast<const UnalignedFloat*>(p); }
static inline Int load_int(const std::int32_t* p) { return *reinterpret_cast<const UnalignedInt*>(p); }
static inline void store(float* p, Float v) { *reinterpret_cast<UnalignedFloat*>(p) = v; }
static inline void store_int(std::int32_t* p, Int v) { *reinterpret_cast<UnalignedInt*>(p) = v; }
static inline Float to_float(Int v) { return __builtin_convertvector(v, Float); }
static inline Int truncate(Float v) { return __builtin_convertvector(v, Int); }
// Lane numbers 0, 1, 2, ...
static inline Float lane_numbers() {
  Float v{};
  for (int lane = 0; lane < kLanes; ++lane) v[lane] = static_cast<float>(lane);
  return v;
}

// 2^n for n in [0, 30].
static inline Int power_of_two(Int n) {
#if defined(__AVX2__)
  return broadcast_int(1) << n;
#else
  return truncate((Float)((n + 127) << 23));
#endif
}

// --- comparisons and selection ---------------------------------------------------------------------------------------
// All comparisons are false where an operand is NaN.

#if defined(__AVX512F__)

typedef __mmask16 Mask;
// The forms with a full mask compile to the plain instructions, without GCC 12's false alarms about uninitialised
// operands.
constexpr __mmask16 kAll = 0xffff;
static inline Mask greater_equal(Float a, Float b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GE_OQ); }
static inline Mask greater(Float a, Float b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ); }
static inline Mask greater_equal_int(Int a, Int b) { return _mm512_cmpge_epi32_mask((__m512i)a, (__m512i)b); }
static inline Mask both(Mask a, Mask b) { return a & b; }
static inline Mask either(Mask a, Mask b) { return a | b; }
static inline std::uint32_t bits(Mask m) { return m; }
static inline bool any(Mask m) { return m != 0; }
static inline Float select(Mask m, Float a, Float b) { return (Float)_mm512_mask_blend_ps(m, (__m512)b, (__m512)a); }
static inline Int select_int(Mask m, Int a, Int b) {
  return (Int)_mm512_mask_blend_epi32(m, (__m512i)b, (__m512i)a);
}
static inline Float zero_unless(Mask m, Float a) { return (Float)_mm512_maskz_mov_ps(m, (__m512)a); }
static inline Float minimum(Float a, Float b) { return (Float)_mm512_maskz_min_ps(kAll, (__m512)a, (__m512)b); }
static inline Float maximum(Float a, Float b) { return (Float)_mm512_maskz_max_ps(kAll, (__m512)a, (__m512)b); }
static inline Float square_root(Float a) { return (Float)_mm512_maskz_sqrt_ps(kAll, (__m512)a); }

#elif defined(__AVX2__)

typedef Int Mask;
static inline Mask greater_equal(Float a, Float b) { return a >= b; }
static inline Mask greater(Float a, Float b) { return a > b; }
static inline Mask greater_equal_int(Int a, Int b) { return a >= b; }
static inline Mask both(Mask a, Mask b) { return a & b; }
static inline Mask either(Mask a, Mask b) { return a | b; }
static inline std::uint32_t bits(Mask m) { return static_cast<std::uint32_t>(_mm256_movemask_ps((__m256)m)); }
static inline bool any(Mask m) { return bits(m) != 0; }
static inline Float select(Mask m, Float a, Float b) {
  return (Float)_mm256_blendv_ps((__m256)b, (__m256)a, (__m256)m);
}
static inline Int select_int(Mask m, Int a, Int b) {
  return (Int)_mm256_blendv_epi8((__m256i)b, (__m256i)a, (__m256i)m);
}
static inline Float zero_unless(Mask m, Float a) { return (Float)((Int)a & m); }
static inline Float minimum(Float a, Float b) { return (Float)_mm256_min_ps((__m256)a, (__m256)b); }
static inline Float maximum(Float a, Float b) { return (Float)_mm256_max_ps((__m256)a, (__m256)b); }
static inline Float square_root(Float a) { return (Float)_mm256_sqrt_ps((__m256)a); }

#else

typedef Int Mask;
static inline Mask greater_equal(Float a, Float b) { return a >= b; }
static inline Mask greater(Float a, Float b) { return a > b; }
static inline Mask greater_equal_int(Int a, Int b) { return a >= b; }
static inline Mask both(Mask a, Mask b) { return a & b; }
static inline Mask either(Mask a, Mask b) { return a | b; }
static inline Float select(Mask m, Float a, Float b) { return (Float)(((Int)a & m) | ((Int)b & ~m)); }
static inline Int select_int(Mask m, Int a, Int b) { return (a & m) | (b & ~m); }
static inline Float zero_unless(Mask m, Float a) { return (Float)((Int)a & m); }
#if defined(__SSE2__)
static inline std::uint32_t bits(Mask m) { return static_cast<std::uint32_t>(_mm_movemask_ps((__m128)m)); }
static inline Float minimum(Float a, Float b) { return (Float)_mm_min_ps((__m128)a, (__m128)b); }
static inline Float maximum(Float a, Float b) { return (Float)_mm_max_ps((__m128)a, (__m128)b); }
static inline Float square_root(Float a) { return (Float)_mm_sqrt_ps((__m128)a); }
#else
static inline std::uint32_t bits(Mask m) { return (m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8); }
static inline Float minimum(Float a, Float b) { return select(a < b, a, b); }
static inline Float maximum(Float a, Float b) { return select(a > b, a, b); }
static inline Float square_root(Float a) {
#if defined(__ARM_NEON) && defined(__aarch64__)
  return (Float)vsqrtq_f32((float32x4_t)a);
#else
  for (int lane = 0; lane < kLanes; ++lane) a[lane] = __builtin_sqrtf(a[lane]);
  return a;
#endif
}
#endif
static inline bool any(Mask m) { return bits(m) != 0; }

#endif

static inline Float absolute(Float a) { return (Float)((Int)a & 0x7fffffff); }
static inline Float clamp(Float a, Float low, Float high) { return minimum(maximum(a, low), high); }

// --- elementary functions --------------------------------------------------------------------------------------------

// 1 / a for normal numbers; within 2 units in the last place, and exactly 1 for a = 1.
static inline Float reciprocal(Float a) {
#if defined(__AVX512F__)
  const Float r = (Float)_mm512_maskz_rcp14_ps(kAll, (__m512)a);
  return r * (2.0f - a * r);
#else
  return 1.0f / a;
#endif
}

#if defined(__AVX512F__)

// 2^(j / 32), j = 0..31.
alignas(64) static constexpr float kRoots[32] = {
    1.0f, 1.0218972f, 1.04427373f, 1.06714046f, 1.09050775f, 1.1143868f, 1.13878858f, 1.1637249f,
    1.18920708f, 1.21524739f, 1.24185777f, 1.26905096f, 1.29683959f, 1.32523668f, 1.35425556f, 1.38390994f,
    1.41421354f, 1.44518077f, 1.47682619f, 1.50916445f, 1.54221082f, 1.5759809f, 1.61049032f, 1.64575553f,
    1.68179286f, 1.71861935f, 1.75625217f, 1.79470909f, 1.8340081f, 1.87416768f, 1.91520655f, 1.95714414f,
};

// 2^x, relative error below 2e-7: 2^n times a number of the table times a minimax polynomial on [-1/64, 1/64]. Lanes
// outside [-126, 127] are garbage, which may be infinite or NaN: callers mask them.
static inline Float exp2_unchecked(Float x) {
  constexpr float kMagic = 393216.0f;  // 1.5 * 2^18: adding it leaves 32 x, rounded, in the low mantissa bits
  const Float shifted = x + kMagic, rounded = shifted - kMagic, f = x - rounded;
  const Float root =
      (Float)_mm512_permutex2var_ps(_mm512_load_ps(kRoots), (__m512i)shifted, _mm512_load_ps(kRoots + 16));
  const Float p = root * (f * (2.402265070e-1f * f + 6.931573442e-1f)) + root;
  return (Float)_mm512_maskz_scalef_ps(kAll, (__m512)p, (__m512)rounded);
}

#else

// 2^x, relative error below 1.5e-7 (minimax polynomial on [-1/2, 1/2]). Lanes outside [-126, 127] are garbage, which
// may be infinite or NaN: callers mask them.
static inline Float exp2_unchecked(Float x) {
  constexpr float kMagic = 12582912.0f;  // 1.5 * 2^23: adding it leaves the rounded integer in the low mantissa bits
  const Float shifted = x + kMagic, f = x - (shifted - kMagic);
  Float p = 1.327647178e-3f * f + 9.675541333e-3f;
  p = p * f + 5.550713274e-2f;
  p = p * f + 2.402211972e-1f;
  p = p * f + 6.931469671e-1f;
  p = p * f + 1.000000072f;
  return (Float)((Bits)p + ((Bits)shifted << 23));  // unsigned: sums of garbage wrap around
}

#endif

// 2^x with x clamped to [-126, 127].
static inline Float exp2(Float x) { return exp2_unchecked(clamp(x, broadcast(-126.0f), broadcast(127.0f))); }

// log2(x) for positive normal x, absolute error about 1e-7 times the larger of 1 and the result.
static inline Float log2(Float x) {
  const Int raw = (Int)x;
  const Float exponent = to_float((raw >> 23) - 127);
  const Float mantissa = (Float)((raw & 0x7fffff) | 0x3f800000);
  const Mask upper = greater_equal(mantissa, broadcast(1.41421356f));
  const Float m = select(upper, mantissa * 0.5f, mantissa);
  const Float e = select(upper, exponent + 1.0f, exponent);
  const Float z = (m - 1.0f) / (m + 1.0f), z2 = z * z;
  return e + z * (2.885390080f + z2 * (0.9617988537f + z2 * (0.5767138337f + z2 * 0.4317483410f)));
}

// e^x and 1 / (1 + e^-x), accurate to a few 1e-7 relative for |x| < 80, saturating beyond.
static inline Float exponential(Float x) { return exp2(x * 1.44269504f); }
static inline Float sigmoid(Float x) { return 1.0f / (1.0f + exponential(-x)); }

// --- horizontal sums -------------------------------------------------------------------------------------------------

// Sums of the lanes of four vectors at once, to out[0..3]. The order of the additions is fixed.
static inline void sum4(Float a, Float b, Float c, Float d, float* out) {
#if defined(__AVX512F__)
  const __m512 va = (__m512)a, vb = (__m512)b, vc = (__m512)c, vd = (__m512)d;
  const __m512 ab = _mm512_maskz_unpacklo_ps(kAll, va, vb) + _mm512_maskz_unpackhi_ps(kAll, va, vb);
  const __m512 cd = _mm512_maskz_unpacklo_ps(kAll, vc, vd) + _mm512_maskz_unpackhi_ps(kAll, vc, vd);
  const __m512 abcd = _mm512_maskz_shuffle_ps(kAll, ab, cd, 0x44) + _mm512_maskz_shuffle_ps(kAll, ab, cd, 0xEE);
  const __m256 half = _mm512_maskz_extractf32x8_ps(0xff, abcd, 0) + _mm512_maskz_extractf32x8_ps(0xff, abcd, 1);
  _mm_storeu_ps(out, _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1)));
#elif defined(__AVX2__)
  const __m256 ab = _mm256_add_ps(_mm256_unpacklo_ps((__m256)a, (__m256)b), _mm256_unpackhi_ps((__m256)a, (__m256)b));
  const __m256 cd = _mm256_add_ps(_mm256_unpacklo_ps((__m256)c, (__m256)d), _mm256_unpackhi_ps((__m256)c, (__m256)d));
  const __m256 abcd = _mm256_add_ps(_mm256_shuffle_ps(ab, cd, 0x44), _mm256_shuffle_ps(ab, cd, 0xEE));
  _mm_storeu_ps(out, _mm_add_ps(_mm256_castps256_ps128(abcd), _mm256_extractf128_ps(abcd, 1)));
#elif defined(__SSE2__)
  const __m128 ab = _mm_add_ps(_mm_unpacklo_ps((__m128)a, (__m128)b), _mm_unpackhi_ps((__m128)a, (__m128)b));
  const __m128 cd = _mm_add_ps(_mm_unpacklo_ps((__m128)c, (__m128)d), _mm_unpackhi_ps((__m128)c, (__m128)d));
  _mm_storeu_ps(out, _mm_add_ps(_mm_shuffle_ps(ab, cd, 0x44), _mm_shuffle_ps(ab, cd, 0xEE)));
#else
  out[0] = (a[0] + a[2]) + (a[1] + a[3]);
  out[1] = (b[0] + b[2]) + (b[1] + b[3]);
  out[2] = (c[0] + c[2]) + (c[1] + c[3]);
  out[3] = (d[0] + d[2]) + (d[1] + d[3]);
#endif
}

// Sums of the lanes of ten vectors at once, to out[0..9]; what follows up to out[15] may be overwritten. The order of the
// additions is fixed.
static inline void sum10(const Float* v, float* out) {
#if defined(__AVX512F__)
  const auto pair = [](Float a, Float b) {  // per quarter: a0 + a2, b0 + b2, a1 + a3, b1 + b3
    return (Float)(_mm512_maskz_unpacklo_ps(kAll, (__m512)a, (__m512)b) +
                   _mm512_maskz_unpackhi_ps(kAll, (__m512)a, (__m512)b));
  };
  const auto four = [](Float ab, Float cd) {  // per quarter: the sums of a, b, c, d
    return (Float)(_mm512_maskz_shuffle_ps(kAll, (__m512)ab, (__m512)cd, 0x44) +
                   _mm512_maskz_shuffle_ps(kAll, (__m512)ab, (__m512)cd, 0xEE));
  };
  const auto quarters = [](Float p, Float q) {  // p0 + p1, p2 + p3, q0 + q1, q2 + q3
    return (Float)(_mm512_maskz_shuffle_f32x4(kAll, (__m512)p, (__m512)q, 0x88) +
                   _mm512_maskz_shuffle_f32x4(kAll, (__m512)p, (__m512)q, 0xDD));
  };
  const Float first = four(pair(v[0], v[1]), pair(v[2], v[3])), second = four(pair(v[4], v[5]), pair(v[6], v[7]));
  const Float last = pair(v[8], v[9]), third = four(last, last);
  store(out, quarters(quarters(first, second), quarters(third, third)));
#elif defined(__AVX2__)
  const auto pair = [](Float a, Float b) {
    return (Float)(_mm256_unpacklo_ps((__m256)a, (__m256)b) + _mm256_unpackhi_ps((__m256)a, (__m256)b));
  };
  const auto four = [](Float ab, Float cd) {
    return (Float)(_mm256_shuffle_ps((__m256)ab, (__m256)cd, 0x44) + _mm256_shuffle_ps((__m256)ab, (__m256)cd, 0xEE));
  };
  const __m256 first = (__m256)four(pair(v[0], v[1]), pair(v[2], v[3]));
  const __m256 second = (__m256)four(pair(v[4], v[5]), pair(v[6], v[7]));
  const Float last = pair(v[8], v[9]);
  const __m256 third = (__m256)four(last, last);
  _mm256_storeu_ps(out, _mm256_permute2f128_ps(first, second, 0x20) + _mm256_permute2f128_ps(first, second, 0x31));
  _mm_storeu_ps(out + 8, _mm256_castps256_ps128(third) + _mm256_extractf128_ps(third, 1));
#else
  sum4(v[0], v[1], v[2], v[3], out);
  sum4(v[4], v[5], v[6], v[7], out + 4);
  sum4(v[8], v[9], v[8], v[9], out + 8);
#endif
}

// Sum of the lanes.
static inline float sum(Float a) {
  float out[4];
  sum4(a, a, a, a, out);
  return out[0];
}

}  // namespace ggslam::GGSLAM_ISA
