// SPDX-License-Identifier: Apache-2.0
#include "tracking/target_part.hpp"

#include <algorithm>
#include <memory>

#include "tracking/target_kernels.hpp"

namespace ggslam {
namespace {

constexpr int kCoarseBits = 19;  // of a coarse block's coordinate along one axis
constexpr int kCoarseHalf = 1 << (kCoarseBits - 1);

struct Member {
  uint64_t order, key;
  int32_t bit, gaussian;
};

std::vector<Member> sorted_members(Isa isa, const TargetInput& input, const TargetSettings& settings) {
  const std::size_t n = static_cast<std::size_t>(input.count);
  std::unique_ptr<uint64_t[]> keys(new uint64_t[n]);
  std::unique_ptr<uint8_t[]> bits(new uint8_t[n]);
  GGSLAM_DISPATCH(isa, bin_gaussians)(input, settings, 0, n, keys.get(), bits.get());
  std::vector<Member> members;
  members.reserve(n);
  for (std::size_t g = 0; g < n; ++g)
    if (keys[g] != kEmptyKey) members.push_back({block_order(keys[g]), keys[g], bits[g], static_cast<int32_t>(g)});
  std::sort(members.begin(), members.end(), [](const Member& x, const Member& y) {
    if (x.order != y.order) return x.order < y.order;
    return x.bit != y.bit ? x.bit < y.bit : x.gaussian < y.gaussian;
  });
  return members;
}

// Three numbers of `bits` each, x lowest, less `half`.
Vec3i unpack(uint64_t packed, int bits, int half) {
  const uint64_t mask = (uint64_t{1} << bits) - 1;
  const Vec3<uint64_t> c{{packed & mask, packed >> bits & mask, packed >> 2 * bits & mask}};
  return cast<int>(c) - Vec3i::all(half);
}

template <typename T>
std::size_t bytes_of(const std::vector<T>& values) {
  return values.capacity() * sizeof(T);
}

}  // namespace

Vec3i block_coordinates(uint64_t key) { return unpack(key, 21, 1 << 20); }

VoxelMoments empty_moments(uint64_t key, int bit, float size) {
  VoxelMoments m{};
  const Vec3i voxel = 4 * block_coordinates(key) + Vec3i{{bit & 3, bit >> 2 & 3, bit >> 4}};
  (size * (cast<float>(voxel) + Vec3f::all(0.5f))).to(m.centre);
  return m;
}

uint64_t block_order(uint64_t key) {
  const Vec3i c = block_coordinates(key);
  uint64_t order = 0;
  for (int a = 2; a >= 0; --a) order = order << kCoarseBits | static_cast<uint64_t>((c[a] >> 2) + kCoarseHalf);
  return order << 6 | static_cast<uint64_t>((c[0] & 3) + 4 * (c[1] & 3) + 16 * (c[2] & 3));
}

uint64_t coarse_key_of(uint64_t order) {
  const Vec3i c = unpack(order >> 6, kCoarseBits, kCoarseHalf);
  return block_key(c[0], c[1], c[2]);
}

VoxelMoments coarse_moments(Isa isa, uint64_t key, const VoxelMoments* moments, std::size_t count, float coarse_size) {
  const uint64_t order = block_order(key);
  VoxelMoments sum = empty_moments(coarse_key_of(order), static_cast<int>(order & 63), coarse_size);
  GGSLAM_DISPATCH(isa, merge_moments)(moments, count, &sum);
  return sum;
}

void TargetPart::build(Isa isa, const TargetInput& input, const TargetSettings& settings) {
  const std::vector<Member> members = sorted_members(isa, input, settings);
  std::vector<int32_t> order(members.size()), voxel_of(members.size());
  for (std::size_t i = 0; i < members.size(); ++i) {
    const Member& m = members[i];
    if (orders.empty() || orders.back() != m.order) {
      orders.push_back(m.order);
      keys.push_back(m.key);
      blocks.push_back({0, static_cast<uint32_t>(moments.size()), 0});
    }
    const uint64_t bit = uint64_t{1} << m.bit;
    if (!(blocks.back().occupied & bit)) {
      blocks.back().occupied |= bit;
      moments.push_back(empty_moments(m.key, m.bit, settings.voxel));
    }
    order[i] = m.gaussian;
    voxel_of[i] = static_cast<int32_t>(moments.size()) - 1;
  }
  GGSLAM_DISPATCH(isa, accumulate_members)(input, settings, order.data(), voxel_of.data(), members.size(), moments.data());
  for (std::size_t b = 0; b < blocks.size(); ++b)
    coarse_moments.push_back(ggslam::coarse_moments(isa, keys[b], moments.data() + blocks[b].first,
                                                    __builtin_popcountll(blocks[b].occupied), 4 * settings.voxel));
  if (settings.neighbour_weight > 0) return;
  const auto finish = GGSLAM_DISPATCH(isa, finish_voxels);
  VoxelLevelView level{};  // of which only the size counts without neighbours
  level.size = settings.voxel;
  voxels.resize(moments.size());
  finish(settings, level, moments.data(), 0, moments.size(), voxels.data());
  level.size = 4 * settings.voxel;
  coarse_voxels.resize(coarse_moments.size());
  finish(settings, level, coarse_moments.data(), 0, coarse_moments.size(), coarse_voxels.data());
}

std::size_t TargetPart::bytes() const {
  return bytes_of(orders) + bytes_of(keys) + bytes_of(blocks) + bytes_of(moments) + bytes_of(coarse_moments) +
         bytes_of(voxels) + bytes_of(coarse_voxels);
}

}  // namespace ggslam
