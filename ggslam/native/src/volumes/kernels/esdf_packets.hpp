// SPDX-License-Identifier: Apache-2.0
// Packets of neighbouring voxels of a block, a lane each, and lists of what may be near them.
#pragma once
#include <algorithm>
#include <cstring>
#include <vector>

#include "volumes/kernels/esdf_near.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

using namespace ggslam::volumes;

// Voxels of a packet along x, y and z.
constexpr int kWide = kLanes >= 16 ? 4 : 2, kHigh = 2, kDeep = kLanes >= 8 ? 2 : 1;
static_assert(kWide * kHigh * kDeep == kLanes && kPart % kWide == 0 && kPart % kHigh == 0 && kPart % kDeep == 0);
constexpr uint32_t kNoGradient = 511u | 511u << 10 | 511u << 20;

// A site that voxels of a packet may have, and where its block lies from this one, in voxels.
struct Holder {
  const Site* site;
  uint32_t owner;
  int shift[3];
};

bool comes_before(const Holder& a, const Holder& b) {
  const Vec3i p = Vec3i::from(a.shift) + voxel_of(a.site->voxel), q = Vec3i::from(b.shift) + voxel_of(b.site->voxel);
  return p[2] != q[2] ? p[2] < q[2] : p[1] != q[1] ? p[1] < q[1] : p[0] < q[0];
}

// The values of a packet's voxels; `at`: of a block, from the packet's first voxel.
template <class T>
Int load_packet(const T* at) {
  static_assert(sizeof(T) == sizeof(int32_t));
  alignas(64) T values[kLanes];
  for (int k = 0; k < kDeep; ++k)
    for (int j = 0; j < kHigh; ++j)
      std::memcpy(values + kWide * (j + kHigh * k), at + kSide * j + kSide * kSide * k, kWide * sizeof(T));
  return load_int(reinterpret_cast<const int32_t*>(values));
}

template <class T>
void store_packet(T* at, Int packet) {
  alignas(64) int32_t values[kLanes];
  store_int(values, packet);
  for (int k = 0; k < kDeep; ++k)
    for (int j = 0; j < kHigh; ++j)
      std::memcpy(at + kSide * j + kSide * kSide * k, values + kWide * (j + kHigh * k), kWide * sizeof(T));
}

// Of the lanes.
float largest(Float a) {
#if defined(__AVX512F__)
  const __m256 half = _mm256_max_ps(_mm512_maskz_extractf32x8_ps(0xff, (__m512)a, 0),
                                    _mm512_maskz_extractf32x8_ps(0xff, (__m512)a, 1));
#elif defined(__AVX2__)
  const __m256 half = (__m256)a;
#endif
#if defined(__AVX2__)
  __m128 four = _mm_max_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1));
  four = _mm_max_ps(four, _mm_movehl_ps(four, four));
  return _mm_cvtss_f32(_mm_max_ss(four, _mm_shuffle_ps(four, four, 1)));
#else
  float most = a[0];
  for (int lane = 1; lane < kLanes; ++lane) most = std::max(most, a[lane]);
  return most;
#endif
}

uint32_t equal(Int a, Int b) { return bits(both(greater_equal_int(a, b), greater_equal_int(b, a))); }

// Bits as a mask of lanes.
Mask mask_of(uint32_t lanes) {
#if defined(__AVX512F__)
  return static_cast<Mask>(lanes);
#else
  Int bit{};
  for (int lane = 0; lane < kLanes; ++lane) bit[lane] = 1 << lane;
  return greater_equal_int(broadcast_int(static_cast<int32_t>(lanes)) & bit, broadcast_int(1));
#endif
}

// Those lanes of the packet at (x, y, z) whose bits are set.
uint32_t lanes_of(const uint64_t* words, int x, int y, int z) {
  uint32_t lanes = 0;
  for (int k = 0; k < kDeep; ++k)
    for (int j = 0; j < kHigh; ++j) {
      const uint32_t wide = static_cast<uint32_t>(words[z + k] >> (x + kSide * (y + j))) & ((1u << kWide) - 1);
      lanes |= wide << (kWide * (j + kHigh * k));
    }
  return lanes;
}

constexpr int kHere[3] = {0, 0, 0};
constexpr float kNoReach = -3e38f;  // Reach.most where there is nothing

// Discs as columns: middle, normal, radius, and of nodes half the thickness; with room for a full vector behind them.
struct Discs {
  const float* first;
  std::size_t stride;
  int32_t count;
  const float* column(int c) const { return first + c * stride; }
};

Discs discs_of(const SiteGroup& group) { return {group.columns, group.stride, group.count}; }

// Which of kLanes discs from `i` on, wider by `slack`, may be nearer to one of some voxels than what that has; places of
// discs are from `shift`.
uint32_t may_be_nearer(const Reach& reach, const Discs& discs, const int shift[3], float slack, Float half, int i) {
  Float from[3], normal[3];
  for (int a = 0; a < 3; ++a) {
    from[a] = (reach.middle[a] - static_cast<float>(shift[a])) - load(discs.column(a) + i);
    normal[a] = load(discs.column(3 + a) + i);
  }
  const uint32_t near = bits(may_be_nearer(reach, from, normal, load(discs.column(6) + i) + slack, half));
  return discs.count - i < kLanes ? near & ((1u << (discs.count - i)) - 1) : near;
}

// From the middles of discs to the lanes, and how far those are from the discs.
struct Gap {
  Float from[3], height, aside;  // along the normal; beside it, from the middle

  Float square(const Site& site) const {
    const Float beyond = maximum(aside - site.radius, Float{});
    return height * height + beyond * beyond;
  }
};

// Groups that may matter to a part of the block.
class NearGroups {
 public:
  void clear() { count_ = 0; }
  bool empty() const { return count_ == 0; }
  int count() const { return count_; }
  int32_t number(int i) const { return numbers_[i]; }
  Discs discs() const { return {columns_.data(), room_, count_}; }

  void reserve(int count) {
    room_ = static_cast<std::size_t>(count + kLanes);
    if (columns_.size() < kColumns * room_) columns_.resize(kColumns * room_);
    if (numbers_.size() < static_cast<std::size_t>(count)) numbers_.resize(count);
    count_ = 0;
  }

  void add(const NodeColumns& from, const int32_t* numbers, int i) {
    for (int c = 0; c < kColumns; ++c) columns_[c * room_ + count_] = from.column(c)[i];
    numbers_[count_++] = numbers[i];
  }

 private:
  static constexpr int kColumns = 8;  // without the place within
  std::size_t room_ = 0;
  int count_ = 0;
  std::vector<float> columns_;
  std::vector<int32_t> numbers_;
};

// Sites that may matter to a part of the block, places from the block's first voxel.
class NearSites {
 public:
  void clear() { sites_.clear(); }
  bool empty() const { return sites_.empty(); }
  int count() const { return static_cast<int>(sites_.size()); }
  const Holder& site(int i) const { return sites_[i]; }
  Discs discs() const { return {columns_.data(), room_, count()}; }

  void add(const Site* site, uint32_t owner, const int shift[3]) {
    const std::size_t i = sites_.size();
    if (i + kLanes >= room_) grow();
    for (int a = 0; a < 3; ++a) {
      columns_[a * room_ + i] = site->at[a] + static_cast<float>(shift[a]);
      columns_[(3 + a) * room_ + i] = site->normal[a];
    }
    columns_[6 * room_ + i] = site->radius;
    sites_.push_back({site, owner, {shift[0], shift[1], shift[2]}});
  }

 private:
  std::size_t room_ = 0;  // a full vector more than what fits
  std::vector<float> columns_;
  std::vector<Holder> sites_;

  void grow() {
    const std::size_t room = 2 * room_ + 256;
    std::vector<float> columns(kSiteColumns * room);
    for (int c = 0; c < kSiteColumns; ++c)
      std::copy_n(columns_.begin() + c * room_, room_, columns.begin() + c * room);
    columns_.swap(columns);
    room_ = room;
  }
};

}  // namespace
}  // namespace ggslam::GGSLAM_ISA
