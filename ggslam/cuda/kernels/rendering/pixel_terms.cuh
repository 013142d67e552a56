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
#include "abi/cuda/rendering.hpp"

namespace ggslam::cuda {

constexpr int kTermThreads = 256, kTermWarps = kTermThreads / kWarp;
constexpr int kMaxTermChannels = 64;
constexpr int kVoteSlots = 4;        // object ids that a Gaussian keeps votes for
constexpr int kDistinctLabels = 16;  // of a pixel that are told apart

}  // namespace ggslam::cuda
