// SPDX-License-Identifier: Apache-2.0
// Cross-entropy of classified features: what threads and kernel share.
#pragma once
#include <cstddef>
#include <cstdint>

#include "common/dispatch.hpp"
#include "abi/core/mapping.hpp"

namespace ggslam {

constexpr std::int64_t kEntropyPixels = 256;  // of a part; parts are added up in their order
constexpr int kMostEntropyChannels = 64;

// Logits of as many pixels as a vector has lanes, class by class.
inline std::size_t entropy_logit_floats(int classes) { return static_cast<std::size_t>(classes) * 16; }

}  // namespace ggslam

// Adds the pixels [begin, end) to `rows` [K, F + 1] and returns the sum of their losses. Writes their d_features.
// `logits`: entropy_logit_floats(K), 64-byte aligned; `share`: 1 / pixels that count.
GGSLAM_DECLARE_KERNEL(double cross_entropy_part(const CrossEntropyOfPixels& job, std::int64_t begin, std::int64_t end,
                                                float share, float* logits, float* rows))
