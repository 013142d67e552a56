// SPDX-License-Identifier: Apache-2.0
// The CUDA kernels of mapping: image loss, insertion, identity learning, steps of the keyframes' poses and exposures.
// Pointers lead to device memory. Calls only start work on the caller's stream; those with a status return 0 or a
// cudaError_t.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/export.hpp"

namespace ggslam::cuda {

// What a view is compared with, as in ImageLossJob.
struct TargetImages {
  const std::uint8_t* color;
  const void* depth;
  const std::uint8_t* valid;
  float depth_scale;
  std::int32_t depth_is_float;
};

// One evaluation, all pointers lead to device memory.
struct ImageLossJob {
  // Rendered: colour [3, H, W], accumulated depth [H, W] in metres, alpha [H, W].
  const float *image, *depth, *alpha;
  // Target: colour [H, W, 3], depth [H, W] (uint16 or float, see target_depth_is_float), 0 = none.
  const std::uint8_t* target_color;
  const void* target_depth;
  const std::uint8_t* target_valid;  // [H, W], 0 where the target shows nothing: its colour does not count; may be null
  const TargetImages* target;  // on the device, read when it is compared, in place of what is given here; may be null
  const float* exposure;  // [3][2], gain and offset of R, G, B; null: 1 and 0
  // Gradients of the loss, shaped like the rendered images.
  float *d_image, *d_depth, *d_alpha;
  double* results;  // [kLossResults], in the order of LossResult
  void* workspace;
  void* stream;
  std::int32_t device, height, width;
  std::int32_t target_depth_is_float;
  std::int32_t normalised_depth;  // compare depth / alpha with the target instead of depth
  std::int32_t charbonnier;       // sqrt(r^2 + eps^2) - eps instead of |r| for colour
  float depth_scale;              // metres per unit of target_depth
  float dssim_weight, depth_weight, opacity_weight, no_depth_weight, minimum_alpha, charbonnier_epsilon;
  // Where the geometric mean of the exposure's gains is larger than this, colours of pixels with a channel of at least
  // so much (0 to 255) do not count; 0: all count.
  float overexposed_gain, saturated_from;
};

// NaN where nothing was measured. The gradient of the exposure, [3][2], follows.
enum LossResult { kTotal, kColor, kL1, kSsim, kDepth, kOpacity, kDepthL1, kPsnr, kValidPixels, kExposureGradient };

// One keyframe, all pointers lead to device memory.
struct InsertionJob {
  const std::uint8_t* color;     // [H, W, 3]
  const std::uint16_t* depth;    // [H, W], 0 = none
  const float *alpha, *rendered_depth;  // [H, W], rendered: alpha and expected depth in metres; both null: an empty map
  // Written by ggslam_cuda_insertion_select: how many Gaussians there will be.
  std::int32_t* total;
  // Written by ggslam_cuda_insertion_build, of `count` rows: [3], [4] wxyz, [3], and flat pixel indices.
  float *means, *quaternions, *log_scales;
  std::int32_t* pixels;
  float* colors;  // the first three of each row's color_numbers: R, G, B in [0, 1], or
  std::int32_t as_harmonics;   // 1: their constant coefficients of spherical harmonics
  std::int32_t color_numbers;
  void* workspace;
  void* stream;
  std::int32_t device, height, width, count;
  std::int32_t adaptive_stride, fill_stride;
  float units_per_metre;  // of depth
  float fx, fy, cx, cy;
  float rotation[9], translation[3];  // of T_world_camera
  float alpha_threshold, depth_tolerance_m, depth_tolerance_relative, scale_pixels, flatness, max_slope,
      texture_threshold, max_depth_m;
};

// All pointers lead to device memory.
struct PixelPoolJob {
  const std::uint16_t* mask;   // [H, W], 0 = unlabelled
  const std::int32_t* alias;   // [65536], what ids have become
  std::int32_t* pixels;        // [drawn], flat indices
  float* vote_weights;         // [drawn], the inverse of their odds, mean 1; 0 where nothing is labelled
  void* workspace;
  void* stream;
  double balance, boundary;    // see IdentitySettings
  std::uint64_t seed, draw;    // which random numbers: those of a draw's number are its own
  std::int32_t device, height, width, drawn;
};

// The most neighbours of each row that a search finds.
constexpr int kMostNeighbours = 32;

// At least one row. All pointers lead to device memory.
//
struct NeighbourJob {
  const float* points;       // [N, 3]
  const std::int64_t* rows;  // [M], numbers of points
  std::int64_t* neighbours;  // [M, k]
  void* workspace;
  void* stream;
  std::int32_t device, point_count, row_count, k;  // 1 <= k <= kMostNeighbours, k < N
};

// Labels of pixels, and their classes. All pointers lead to device memory.
struct PixelClassJob {
  const std::uint16_t* mask;     // [H, W]
  const std::int32_t* pixels;    // [count], flat indices
  const std::int32_t* alias;     // [65536], what ids have become
  const std::int32_t* class_of;  // [65536], number of each id's class, -1 = none
  std::int32_t* labels;          // [count], current ids
  std::int32_t* classes;         // [count], class numbers
  std::int32_t* known;           // [1], how many pixels have a class
  void* stream;
  std::int32_t device, count;
};

struct CrossEntropyJob {
  float* logits;                // [count, classes]; become gradients
  const std::int32_t* targets;  // [count], true classes; -1 = unknown, which counts nothing
  const std::int32_t* known;    // [1], number of rows that the loss is the mean of
  float* losses;                // [count], 0 where unknown
  void* stream;
  float weight;                 // of the loss
  std::int32_t device, count, classes;
};

struct NeighbourLossJob {
  const float* logits;  // [samples * (1 + neighbours), classes]: the samples', then sample by sample their neighbours'
  float* gradients;     // of the same shape
  void* stream;
  float weight;
  std::int32_t device, samples, neighbours, classes;
};

struct ClassAdamJob {
  float *rows, *first_moments, *second_moments;  // [classes, width]
  const float* gradients;                        // [classes, width]
  const std::int32_t* known;                     // [1]; 0: there is no step
  std::int32_t* steps;                           // [1], number of steps so far
  void* stream;
  float rate;
  std::int32_t device;
  std::int64_t size;                             // classes * width
};

struct AdamMoments {
  double first[6], second[6];
};

struct KeyframeState {
  double pose[16];      // T_camera_world, 4 x 4
  double exposure[6];   // gain and offset of R, G, B
  double exposure_anchor[6];  // what the exposure is pulled to
  AdamMoments pose_moments, exposure_moments;
  std::int64_t pose_steps, exposure_steps;
  float pose_copy[12];  // its first three rows, for the rasterizer
  float exposure_copy[6];  // for the image loss
};

// Sums over all iterations, all of them doubles.
struct LossTotals {
  double total, color, ssim, depth;
  double last_psnr;   // of the last iteration, no sum
  double iterations;  // how many there were
};

// A keyframe and how far it goes, as in KeyframeStepJob.
struct KeyframeChoice {
  KeyframeState* state;
  double pose_rate;
  std::int32_t step_exposure;
};

// Pointers lead to device memory.
struct KeyframeStepJob {
  KeyframeState* state;
  const double *twist, *results;  // [6], gradient of the pose; [kLossResults] of the image loss
  const std::int32_t* skipped;    // [1], not 0: nothing is to be done; null: 0
  LossTotals* totals;
  const KeyframeChoice* choice;   // on the device, read when the step is made, in place of what is given here; may be null
  void* stream;
  double pose_rate;  // 0: the pose stays
  double exposure_rate, exposure_regularization;
  std::int32_t step_exposure;  // 0: the exposure stays
  std::int32_t device;
};

struct KeyframeWriteJob {
  KeyframeState* state;
  void* stream;
  double pose[16], exposure[6];
  std::int32_t is_new;  // 0: nothing but the pose is written
  std::int32_t device;
};

}  // namespace ggslam::cuda

// Bytes of memory that the loss works in. Asks for height, width and dssim_weight.
GGSLAM_EXPORT std::int64_t ggslam_cuda_image_loss_bytes(const ggslam::cuda::ImageLossJob* job);

// Values and gradients of the loss. The caller has checked sizes and pointers.
GGSLAM_EXPORT int ggslam_cuda_image_loss(const ggslam::cuda::ImageLossJob* job);

// Bytes of memory that a keyframe takes. Asks for height, width and fill_stride.
GGSLAM_EXPORT std::int64_t ggslam_cuda_insertion_bytes(const ggslam::cuda::InsertionJob* job);

// Chooses the pixels and writes how many they are. The caller has checked sizes and pointers.
GGSLAM_EXPORT int ggslam_cuda_insertion_select(const ggslam::cuda::InsertionJob* job);

// Writes the `count` Gaussians chosen by the call before it with the same job.
GGSLAM_EXPORT int ggslam_cuda_insertion_build(const ggslam::cuda::InsertionJob* job);

// Bytes of memory that a draw takes. Asks for height and width.
GGSLAM_EXPORT std::int64_t ggslam_cuda_pixel_pool_bytes(const ggslam::cuda::PixelPoolJob* job);

// Fills `pixels` and `vote_weights`.
GGSLAM_EXPORT int ggslam_cuda_draw_pixels(const ggslam::cuda::PixelPoolJob* job);

// Bytes of memory that a search takes. Asks for point_count, row_count and k.
GGSLAM_EXPORT std::int64_t ggslam_cuda_neighbours_bytes(const ggslam::cuda::NeighbourJob* job);

// Finds the neighbours. The caller has checked sizes and pointers.
GGSLAM_EXPORT int ggslam_cuda_neighbours(const ggslam::cuda::NeighbourJob* job);

// Fills `labels`.
GGSLAM_EXPORT int ggslam_cuda_pixel_labels(const ggslam::cuda::PixelClassJob* job);

// Fills `classes` and `known` for `labels`.
GGSLAM_EXPORT int ggslam_cuda_pixel_classes(const ggslam::cuda::PixelClassJob* job);

// Turns logits into gradients, and fills `losses`.
GGSLAM_EXPORT int ggslam_cuda_cross_entropy(const ggslam::cuda::CrossEntropyJob* job);

// Fills `gradients`.
GGSLAM_EXPORT int ggslam_cuda_neighbour_loss(const ggslam::cuda::NeighbourLossJob* job);

// One step of the classifier, and of the number of its steps.
GGSLAM_EXPORT int ggslam_cuda_class_adam(const ggslam::cuda::ClassAdamJob* job);

// One step of a keyframe's pose and exposure, and the sums of the loss.
GGSLAM_EXPORT int ggslam_cuda_keyframe_step(const ggslam::cuda::KeyframeStepJob* job);

// Sets a keyframe's pose, or all of its state. The numbers travel as arguments of the kernel: no memory of the host is
// read later.
GGSLAM_EXPORT int ggslam_cuda_keyframe_write(const ggslam::cuda::KeyframeWriteJob* job);
