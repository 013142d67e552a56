// SPDX-License-Identifier: Apache-2.0
// The CUDA kernels' identity learning: whole steps at sampled pixels of a rendering, each by one call. Pointers lead to
// device memory. Calls only start work on the caller's stream; those with a status return 0 or a cudaError_t.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/cuda/mapping.hpp"
#include "abi/cuda/rendering.hpp"
#include "abi/export.hpp"

namespace ggslam::cuda {

// What all steps have in common, as long as nothing that it names is moved.
struct IdentityJob {
  // The map.
  const float* means;                // [N, 3]
  AdamStep adam;                     // features [N, channels], their updates and, but for the rate, their optimizer
  std::int32_t* vote_ids;            // [N, 4]
  float* vote_weights;               // [N, 4]
  // Objects.
  const std::int32_t* alias;         // [65536], what ids have become
  const std::int32_t* class_of;      // [65536], number of each id's class, -1 = none
  const std::int32_t* whole_of;      // [65536], of what an id is a part, 0 = nothing; null: there are no parts
  const std::int32_t* shown;         // [N], what the map shows of ids, for the parts
  // The classifier: weights, then the bias, of each class, and its optimizer.
  float *rows, *first_moments, *second_moments;  // [classes, channels + 1]
  std::int32_t* steps;               // [1]
  // Results.
  float* losses;                     // [pixels], of the cross-entropy, 0 where unknown
  std::int32_t* known;               // [1], pixels whose class is known
  void* workspace;                   // ggslam_cuda_identity_bytes bytes
  std::int64_t gaussians;            // N
  double balance, boundary;          // see IdentitySettings, as all that follows
  double rate, classifier_rate;
  std::uint64_t seed;                // of all draws
  float weight, pull_weight;         // of the cross-entropy; of a sample's pull, before the mean over samples
  float min_weight;                  // of a term
  std::int32_t channels, classes;
  std::int32_t pixels, capacity;     // in a step; terms of each
  std::int32_t samples, neighbours;  // of the pull; 0: there is none
  std::int32_t trains;               // 0: votes alone are counted
};

// What one step has for itself.
struct IdentityStep {
  const std::uint16_t* mask;  // [H, W]
  std::int32_t* pool;         // [drawn], pixels, flat indices
  float* pool_weights;        // [drawn], of their votes
  std::uint64_t draw, pull;   // numbers of the draws, so that none is made twice
  double rate_factor;
  std::int32_t drawn;         // 0, or so many pixels are drawn first
  std::int32_t used;          // pixels of the pool that are used up
  std::int32_t pulls;         // 1: neighbours are pulled together
};

}  // namespace ggslam::cuda

// Bytes of memory that steps take at pixels of images of height x width.
GGSLAM_EXPORT std::int64_t ggslam_cuda_identity_bytes(const ggslam::cuda::IdentityJob* job, int height, int width);

// One step at pixels of a rendering whose memory must still be there.
GGSLAM_EXPORT int ggslam_cuda_learn(const ggslam::cuda::IdentityJob* job, const ggslam::cuda::IdentityStep* step,
                                    const ggslam::cuda::Rendering* rendering);
