// SPDX-License-Identifier: Apache-2.0
// The CUDA kernels of a new keyframe: what it sees of the map, and the Gaussians that it brings, each by one call. Pointers
// lead to device memory. Calls only start work on the caller's stream and return 0 or a cudaError_t.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/cuda/growth.hpp"
#include "abi/cuda/mapping.hpp"
#include "abi/cuda/rendering.hpp"
#include "abi/export.hpp"

namespace ggslam::cuda {

// Objects that a rendering shows at some pixels, by the votes of its Gaussians.
struct SeenLabelJob {
  VoteLabelJob votes;          // of the map; labels are written
  PixelTerms terms;            // of these pixels, are written
  const std::int32_t* pixels;  // [P], flat indices
  std::int32_t* ids;           // [P], the label with the largest rendering weight
  float* shares;               // [P], its share of the pixel's weight
  float min_weight;            // of a contribution to a pixel
};

// How bright a keyframe is against the map, by the median of what pixels tell; of each channel R, G, B.
struct BrightnessRatios {
  std::int32_t used[3];  // pixels
  float medians[3];      // keyframe / map; 0 without any
};

// What a new keyframe sees of the map.
struct KeyframeLookJob {
  const float *image, *depth, *alpha;  // rendered: [3, H, W], accumulated [H, W] in metres, [H, W]
  const std::uint8_t* valid;           // [H, W], 0 where the keyframe shows nothing: nothing is missing there; may be null
  const std::int32_t* overflowed;      // [1], of the rendering
  const std::uint8_t* measured_color;  // the keyframe's, [H, W, 3]
  const std::uint16_t* measured_depth;  // likewise, [H, W], 0 = none
  float *explained_alpha, *explained_depth;  // [H, W]; depth in metres, 0 where nothing is shown
  float* pixel_ratios;                 // [3, h, w], of pixels at every ratio_stride-th row and column, to work in
  BrightnessRatios* ratios;            // [1]; may be null
  float* shares;                       // at every label_stride-th row and column, become 0 where alpha is low; may be null
  std::int32_t* was_short;             // [1], becomes what `overflowed` is
  void* stream;
  std::int32_t device, height, width, ratio_stride, label_stride;
  float units_per_metre;               // of measured_depth
  float least_alpha, largest_depth_error, dark, bright;  // of pixels that tell of brightness, see ExposureTuning
};

}  // namespace ggslam::cuda

// What a keyframe sees of a rendering whose memory must still be there, with the objects that it shows (labels may be
// null); then chooses, as ggslam_cuda_insertion_select, what the map lacks there.
GGSLAM_EXPORT int ggslam_cuda_see_map(const ggslam::cuda::Rendering* rendering,
                                      const ggslam::cuda::SeenLabelJob* labels,
                                      const ggslam::cuda::KeyframeLookJob* look,
                                      const ggslam::cuda::InsertionJob* selection);

// Fills the first values of new rows, then, as ggslam_cuda_insertion_build, writes what was chosen to them; then their
// first labels (births may be null).
GGSLAM_EXPORT int ggslam_cuda_insert_rows(const ggslam::cuda::FillJob* fill, const ggslam::cuda::InsertionJob* built,
                                          const ggslam::cuda::BirthLabelJob* births);
