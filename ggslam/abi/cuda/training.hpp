// SPDX-License-Identifier: Apache-2.0
// The CUDA kernels' training: whole steps on the map and on keyframes' poses and exposures, many of them by one call.
// Pointers lead to device memory. Calls only start work on the caller's stream; those with a status return 0 or a
// cudaError_t.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/cuda/sampled_identity.hpp"
#include "abi/cuda/mapping.hpp"
#include "abi/cuda/rendering.hpp"
#include "abi/export.hpp"

namespace ggslam::cuda {

// Steps that may wait on the device at a time.
constexpr int kMostWaitingSteps = 16;

// What all steps have in common, as long as nothing that it names is moved: filled in once, used again and again.
struct TrainingJob {
  Rendering rendering;             // planned; its stream and device are those of all that is started. pose is not read
  ImageGradients image_gradients;  // of the loss
  GaussianGradients gradients;     // twist and touched
  AdamStep adam;                   // rates are not read
  ImageLossJob loss;               // neither the target nor, but for being null, the exposure is read
  KeyframeStepJob keyframe;        // state, pose_rate and step_exposure are not read
  float* row_memory;               // as of ggslam_cuda_backward
  void* desk;                      // ggslam_cuda_training_bytes bytes, zero before they are used first
  float largest_log_scale, darkest, brightest;  // what bounded steps keep sizes and constant coefficients of colours within
  std::int32_t bounds_colors;                   // 0: of sizes alone
};

// What one step has for itself.
struct TrainingStep {
  TargetImages images;
  KeyframeChoice keyframe;
  float rates[kAdamGroups];
  std::int32_t bounded;  // 1: sizes, and perhaps colours, are brought within their bounds after it
  std::int32_t lesson;   // number of the step of identity learning on the same rendering; -1: there is none
};

// What became of pieces of steps: a step, or, with identity learning in its midst, what comes before and after that.
struct GraphCounts {
  std::int64_t started;  // as graphs
  std::int64_t plain;    // kernel by kernel
  std::int64_t made;     // graphs that were recorded and made
  std::int64_t changed;  // graphs that became those of another job
  std::int64_t refused;  // not recorded, because the CUDA runtime refused to; from then on nothing is
};

}  // namespace ggslam::cuda

// Graphs of steps, for the jobs that were used last; and their end, which waits for nothing.
GGSLAM_EXPORT int ggslam_cuda_graphs_create(int device, void** graphs);
GGSLAM_EXPORT void ggslam_cuda_graphs_destroy(void* graphs);
GGSLAM_EXPORT void ggslam_cuda_graph_counts(const void* graphs, ggslam::cuda::GraphCounts* counts);

// Bytes of memory of a desk.
GGSLAM_EXPORT std::int64_t ggslam_cuda_training_bytes();

// Makes `count` steps one after the other: forward, loss, backward with the optimizer, the keyframe's step. A step whose
// rendering finds no room changes nothing and is counted, see Rendering. identity, lessons: of those steps that have one
// of identity learning, else null. graphs: null, or those by which what is used again is started as a whole; what is
// computed is the same. counter: receives the largest number of pairs; recent_pairs: on the host, receives what
// ggslam_cuda_recent_pairs says.
GGSLAM_EXPORT int ggslam_cuda_train(const ggslam::cuda::TrainingJob* job, const ggslam::cuda::TrainingStep* steps,
                                    int count, const ggslam::cuda::IdentityJob* identity,
                                    const ggslam::cuda::IdentityStep* lessons, void* graphs, void* counter,
                                    std::int64_t* recent_pairs);
