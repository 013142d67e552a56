// SPDX-License-Identifier: Apache-2.0
// Surface points of a block of the TSDF: zero crossings on the edges between voxels.
#include <algorithm>
#include <cmath>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

#include "native/formulas/surface_sites.hpp"
#include "volumes/esdf_types.hpp"

namespace ggslam::GGSLAM_ISA {

using namespace ggslam::volumes;

// Which of the 10 values of a row, halo and all, were seen and are negative: bits 0 ... 9.
struct RowBits {
  uint32_t seen, negative;
};

RowBits bits_of(const int16_t* row) {
  RowBits bits{0, 0};
#if defined(__SSE2__)
  const __m128i eight = _mm_loadu_si128(reinterpret_cast<const __m128i*>(row));
  const __m128i unseen = _mm_cmpeq_epi16(eight, _mm_set1_epi16(kUnseen));
  bits.seen = ~static_cast<uint32_t>(_mm_movemask_epi8(_mm_packs_epi16(unseen, unseen))) & 255;
  bits.negative = static_cast<uint32_t>(_mm_movemask_epi8(_mm_packs_epi16(eight, eight))) & 255;
  constexpr int kDone = 8;
#else
  constexpr int kDone = 0;
#endif
  for (int i = kDone; i < kHalo; ++i) {
    bits.seen |= static_cast<uint32_t>(is_seen(row[i])) << i;
    bits.negative |= static_cast<uint32_t>(row[i] < 0) << i;
  }
  return bits;
}

// Bits of the voxels of two neighbouring rows between which the sign changes.
uint32_t change(const RowBits& a, const RowBits& b) { return (a.negative ^ b.negative) & a.seen & b.seen; }

// Sites of the block in the middle of `values` [10, 10, 10] (x fastest; kUnseen where not seen, and in the corners and
// edges of the halo), `unit` voxels each; returns their number, at most 512. Known and negative voxels go to bit i + 8 j of
// word k.
int esdf_crossings(const int16_t* values, Site* out, uint64_t* known, uint64_t* negative, float unit) {
  RowBits rows[kHalo * kHalo];
  for (int row = 0; row < kHalo * kHalo; ++row) rows[row] = bits_of(values + row * kHalo);
  int n = 0;
  for (int k = 0; k < kSide; ++k) {
    known[k] = negative[k] = 0;
    for (int j = 0; j < kSide; ++j) {
      const RowBits* row = rows + (j + 1) + (k + 1) * kHalo;
      const uint64_t own = row->seen >> 1 & 255;
      known[k] |= own << (kSide * j);
      negative[k] |= (row->negative >> 1 & own) << (kSide * j);
      const uint32_t along = change(*row, {row->seen >> 1, row->negative >> 1});
      const uint32_t crossed = along | along << 1 | change(*row, row[-1]) | change(*row, row[1]) |
                               change(*row, row[-kHalo]) | change(*row, row[kHalo]);
      for (uint32_t left = crossed >> 1 & 255; left != 0; left &= left - 1) {
        const int i = __builtin_ctz(left);
        const int16_t* v = values + (i + 1) + (j + 1) * kHalo + (k + 1) * kHalo * kHalo;
        Site& site = out[n];
        if (!point_of(v, site.at)) continue;
        const int place[3] = {i, j, k};
        site.radius = normal_of(v, site.normal) ? radius_of(v, site.at, site.normal, unit) : 0.0f;
        for (int a = 0; a < 3; ++a) site.at[a] += static_cast<float>(place[a]);
        site.voxel = i + kSide * (j + kSide * k);
        ++n;
      }
    }
  }
  return n;
}

}  // namespace ggslam::GGSLAM_ISA
