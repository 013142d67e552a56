// SPDX-License-Identifier: Apache-2.0
// New Gaussians of a keyframe: which pixels get one, and what it looks like.
#pragma once
#include <cstdint>

#include "common/dispatch.hpp"
#include "abi/core/mapping.hpp"

namespace ggslam {

// Bits of a pixel: colour or depth changes there; depth is unknown there, or jumps. In the marks of a job they are those
// of the 3x3 and of the 5x5 pixels around.
constexpr uint8_t kChanges = 1, kBroken = 2;

}  // namespace ggslam

// Grey values of rows [begin, end), as OpenCV has them.
GGSLAM_DECLARE_KERNEL(void insertion_grey(const InsertionJob& job, uint8_t* grey, int begin, int end))
// Bits of the pixels of one row, from `grey` [H, W].
GGSLAM_DECLARE_KERNEL(void insertion_bits(const InsertionJob& job, const uint8_t* grey, uint8_t* bits, int row))
// Marks of one row, from `bits` [H, W], and its chosen pixels, to the front of `pixels`, which has room for W; returns
// their number. `scratch`: room for 2 (W + 4).
GGSLAM_DECLARE_KERNEL(int insertion_choose(const InsertionJob& job, const uint8_t* bits, int row, uint8_t* scratch,
                                           int64_t* pixels))
// Gaussians [begin, end).
GGSLAM_DECLARE_KERNEL(void insertion_shape(const InsertionJob& job, std::int64_t begin, std::int64_t end))
