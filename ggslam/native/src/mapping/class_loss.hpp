// SPDX-License-Identifier: Apache-2.0
// Softmax cross-entropy of identity vectors with its gradients, pixel by pixel, so that no P x K array is written.
#pragma once
#include <cstddef>
#include <cstdint>

#include "common/dispatch.hpp"
#include "interface/core/mapping.hpp"

namespace ggslam {

// Classes and channels are rounded up to whole vectors of any length, with zeros beyond.
inline std::size_t class_loss_padded(int count) { return (static_cast<std::size_t>(count) + 15) / 16 * 16; }

// The classifier as the kernel takes it; K and F are the padded numbers.
struct ClassLossRows {
  const float* by_channel;  // [F, K]
  const float* by_class;    // [K, F]
  const float* biases;      // [K], so low beyond the classes there are that these are never likely
  std::size_t classes, channels;
};

// Floats that one thread needs besides: the probabilities, and one identity vector with its gradient.
inline std::size_t class_loss_scratch(const ClassLossRows& rows) { return rows.classes + 2 * rows.channels; }

}  // namespace ggslam

// Pixels [begin, end): their d_features, and what they add to the rows' gradients, to `sums` [K, F] and `bias_sums` [K],
// zeros at first. Gradients are multiplied by `factor`. Returns the sum of their losses.
GGSLAM_DECLARE_KERNEL(double class_loss_pixels(const ClassLossJob& job, const ClassLossRows& rows, float factor,
                                               std::int64_t begin, std::int64_t end, float* scratch, float* sums,
                                               float* bias_sums))
