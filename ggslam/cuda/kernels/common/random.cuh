// SPDX-License-Identifier: Apache-2.0
// Random numbers by counting: any of them is made at once, by whoever wants it.
#pragma once
#include "common/platform.cuh"

namespace ggslam::cuda {

// The finalizer of SplitMix64 (Steele, Lea and Flood 2014).
__host__ __device__ inline std::uint64_t mix_bits(std::uint64_t x) {
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ULL;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebULL;
  return x ^ (x >> 31);
}

// Number `index` of draw `draw`, in [0, 1).
__device__ inline double random_number(std::uint64_t seed, std::uint64_t draw, std::uint64_t index) {
  constexpr std::uint64_t kStep = 0x9e3779b97f4a7c15ULL;
  const std::uint64_t bits = mix_bits(mix_bits(seed + kStep * (draw + 1)) + kStep * (index + 1));
  return static_cast<double>(bits >> 11) * (1.0 / 9007199254740992.0);
}

}  // namespace ggslam::cuda
