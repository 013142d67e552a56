// SPDX-License-Identifier: Apache-2.0
// Sampled compositing, as in native/src/rendering/pixel_terms.hpp: which Gaussians make up a pixel, and with what weight.
//
//   collect_terms_kernel   walks the lists of the last rendering for some pixels          pixel_terms_collect.cuh
//   the others             terms x features, gradients x terms, votes, labels             pixel_terms_use.cuh
//
// All sizes are the host's: P pixels with room for `capacity` terms each, however many are in use. Gaussians beyond the
// map that a kernel is given are passed over, so that terms of another map lead nowhere.
#pragma once
#include "common/platform.cuh"

namespace ggslam::cuda {

constexpr int kTermThreads = 256, kTermWarps = kTermThreads / kWarp;
constexpr int kMaxTermChannels = 64;
constexpr int kVoteSlots = 4;        // object ids that a Gaussian keeps votes for
constexpr int kDistinctLabels = 16;  // of a pixel that are told apart

// The terms of P pixels: the first counts[p] of row p are in use, front to back; the rest are zero. Laid out as in
// ggslam/rendering/cuda/pixel_terms.py.
struct PixelTerms {
  std::int64_t pixels;
  std::int32_t* gaussians;  // [P, capacity]
  float* weights;           // [P, capacity]
  std::int32_t* counts;     // [P]
  void* stream;
  std::int32_t capacity;
  std::int32_t device;
  std::int64_t entries() const { return pixels * capacity; }
};

// All places of the terms, sorted by Gaussian; those of one Gaussian are in the order of the pixels. Places not in use
// come last, under the number `count`.
struct TermsByGaussian {
  std::uint32_t* gaussians;  // [P * capacity]
  std::uint32_t* places;     // [P * capacity], p * capacity + i
  std::int64_t size;         // P * capacity
  std::int64_t count;        // Gaussians in the map
};

}  // namespace ggslam::cuda
