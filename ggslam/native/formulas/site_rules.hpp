// SPDX-License-Identifier: Apache-2.0
// Numbers of the distance field, for CPU and GPU. Lengths in voxels.
#pragma once
#include "native/formulas/tsdf_rules.hpp"

namespace ggslam::volumes {

constexpr int kHalo = kSide + 2;              // side of a block with one voxel around it
constexpr std::int16_t kUnseen = -32768;      // among values of the TSDF

// The surface of a site is taken to be its tangent disc, which reaches half way to the next sites: a larger one would
// stand out of what is curved.
constexpr float kDiscRadius = 0.7f;
// Gradients are those of discs larger by this, so that they do not turn in the gaps between discs.
constexpr float kSmoothRim = 0.25f;
// A site keeps its place until its disc has moved by this.
constexpr float kHeld = 1.0f / 16;

}  // namespace ggslam::volumes
