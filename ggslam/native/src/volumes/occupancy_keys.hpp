// SPDX-License-Identifier: Apache-2.0
// The key grid of OctoMap: along each axis a voxel has the key floor(x / resolution) + 32768, 16 bits. Here the three
// keys are interleaved to one Morton code of 48 bits (x lowest), in which every three bits choose one of OctoMap's
// eight children. The lowest nine bits number the voxels of a block of 8^3, the other 39 are the block's code.
#pragma once
#include <cmath>
#include <cstdint>

#include "common/vector.hpp"

namespace ggslam {

constexpr int kKeyBits = 16;             // levels of the octree
constexpr int kBlockBits = 3;            // levels within a block
constexpr int kBlockDepth = kKeyBits - kBlockBits;
constexpr int kBlockVoxels = 1 << (3 * kBlockBits);
constexpr int kKeyOffset = 32768;
// Rays keep this far from the end of the grid, so that a last step of rounding cannot leave it.
constexpr int kKeyMargin = 4;

constexpr std::uint64_t kAxisX = 0x249249249249u;  // the bits of a Morton code that belong to x
constexpr std::uint64_t kAxisY = kAxisX << 1, kAxisZ = kAxisX << 2;

struct KeyGrid {
  double resolution, factor;  // metres; 1 / resolution
  explicit KeyGrid(double r) : resolution(r), factor(1.0 / r) {}
};

// The bits of a 16-bit number, three places apart.
static inline std::uint64_t spread_bits(std::uint64_t x) {
  x = (x | (x << 16)) & 0x0000ff0000ffu;
  x = (x | (x << 8)) & 0x00f00f00f00fu;
  x = (x | (x << 4)) & 0x0c30c30c30c3u;
  return (x | (x << 2)) & kAxisX;
}

static inline std::uint32_t gather_bits(std::uint64_t x) {
  x &= kAxisX;
  x = (x | (x >> 2)) & 0x0c30c30c30c3u;
  x = (x | (x >> 4)) & 0x00f00f00f00fu;
  x = (x | (x >> 8)) & 0x0000ff0000ffu;
  return static_cast<std::uint32_t>((x | (x >> 16)) & 0xffff);
}

static inline std::uint64_t morton_code(const Vec3i& key) {
  return spread_bits(key[0]) | spread_bits(key[1]) << 1 | spread_bits(key[2]) << 2;
}

static inline Vec3i keys_of_morton(std::uint64_t code) {
  return cast<int>(Vec3<std::uint32_t>{{gather_bits(code), gather_bits(code >> 1), gather_bits(code >> 2)}});
}

// False where a coordinate is not finite or lies outside the grid (less its margin).
static inline bool key_of_point(const KeyGrid& grid, const Vec3f& point, Vec3i& key) {
  for (int i = 0; i < 3; ++i) {
    const double k = std::floor(grid.factor * point[i]) + kKeyOffset;
    if (!(k >= kKeyMargin && k < 2 * kKeyOffset - kKeyMargin)) return false;
    key[i] = static_cast<int>(k);
  }
  return true;
}

// Centre of a voxel along one axis.
static inline double key_centre(const KeyGrid& grid, int key) { return (key - kKeyOffset + 0.5) * grid.resolution; }

}  // namespace ggslam
