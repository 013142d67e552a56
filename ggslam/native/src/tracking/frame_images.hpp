// SPDX-License-Identifier: Apache-2.0
// What is made of every frame's images, in one pass over each.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/core/tracking.hpp"
#include "common/dispatch.hpp"

// Copies depths and counts those that are known.
GGSLAM_DECLARE_KERNEL(int copy_depth(const float* depth, std::size_t count, float* copy))
// A row of `ggslam_shrink_grey`, of `factor` rows of an image `width` pixels wide; `sums`: scratch, 6 `width` elements.
GGSLAM_DECLARE_KERNEL(void shrink_grey_row(const uint8_t* color, int width, int factor, uint16_t* sums, float* grey))
