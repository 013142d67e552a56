// SPDX-License-Identifier: Apache-2.0
// The compiled core's losses, of images and of what pixels are classified as, and the Gaussians that a keyframe brings.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/export.hpp"

namespace ggslam {

// One evaluation of the loss; H = height, W = width.
struct ImageLossJob {
  // Rendered: colour [3, H, W] planar, accumulated depth [H, W] in metres, alpha [H, W].
  const float* image;
  const float* depth;
  const float* alpha;
  // Target: colour [H, W, 3] interleaved, depth [H, W] (uint16 or float, see target_depth_is_float), 0 = none.
  const uint8_t* target_color;
  const void* target_depth;
  const uint8_t* target_valid;  // [H, W], 0 where the target shows nothing: its colour does not count; may be null
  // Gradients of the loss, shaped like the rendered images.
  float* d_image;
  float* d_depth;
  float* d_alpha;

  int32_t height, width;
  int32_t target_row, target_step;  // pixels from one of the target's to that below, and to the next one
  int32_t target_depth_is_float;
  int32_t normalised_depth;  // compare depth / alpha with the target instead of depth
  int32_t charbonnier;       // sqrt(r^2 + eps^2) - eps instead of |r| for colour
  float depth_scale;         // metres per unit of target_depth
  float exposure[6];         // gain, offset for R, G, B: corrected = gain * rendered + offset
  float dssim_weight, depth_weight, opacity_weight, no_depth_weight, minimum_alpha, charbonnier_epsilon;

  // Results; NaN where nothing was measured.
  double total, color, l1, ssim, depth_term, opacity_term, depth_l1_m, psnr;
  double valid_pixels;
  double exposure_gradient[6];
};

// One keyframe to insert Gaussians for; H = height, W = width.
struct InsertionJob {
  const uint8_t* color;  // [H, W, 3]
  const float* depth;    // [H, W], metres; 0, or NaN, where nothing was measured
  const uint8_t* where;  // [H, W], 0 where nothing is inserted; may be null
  uint8_t* marks;        // [H, W], what the selection tells the shaping of each pixel
  int64_t* pixels;       // room for H * W: flat indices of the selected ones, ascending
  // Results, a row for each selected pixel: world frame; wxyz; natural logarithm of metres; in [0, 1].
  float* means;
  float* quaternions;
  float* log_scales;
  float* rgb;
  int32_t height, width;
  int32_t adaptive_stride;  // one Gaussian per 2x2 pixels where nothing changes, else one per pixel
  float fx, fy, cx, cy;
  float rotation[9], translation[3];  // of T_world_camera
  float texture_threshold, max_depth, scale_pixels, flatness, max_slope;  // see mapping.settings.InsertionSettings
};

// Softmax cross-entropy of classified features at P pixels; F channels, K classes. Being nothing competes with the
// classes.
struct CrossEntropyOfPixels {
  const float* features;   // [P, F]
  const int32_t* classes;  // [P], the true class below K; -1: none, the pixel does not count
  const float* weight;     // [K, F]
  const float* bias;       // [K]
  float* d_features;       // [P, F], gradient of the mean; 0 where there is no true class
  float* d_rows;           // [K, F + 1], gradient by the weights, then by the bias
  int64_t pixels;
  int32_t channels, count;
  float nothing_logit;
  double loss;  // result: mean over the pixels that count; 0 without any
};

// What one view tells of the colours of Gaussians, as linear equations for `count` coefficients of spherical harmonics from
// degree 1 on: 3, 8 or 15. Of each Gaussian they are the lower triangle, row by row, then [count, 3] right sides.
struct ViewColorsOfView {
  const float* means;      // [N, 3]
  // Gradients by the constant coefficient, rows `stride` apart: of the sum of the image, and of the sum of what the view
  // shows minus the image. Their quotient is what a Gaussian's pixels miss on average.
  const float* weights;
  const float* residuals;
  float* equations;        // [N, count (count + 1) / 2 + 3 count], which the view's are added to
  int64_t gaussians;       // N
  int32_t stride, count;
  float centre[3];         // of the camera
  float least_weight, most_weight;  // pixels; fewer say nothing, more do not say more
  float usual_residual;    // of a colour; larger ones weigh less, as by an L1 norm
};

}  // namespace ggslam

GGSLAM_EXPORT void* ggslam_image_loss_create();
GGSLAM_EXPORT int ggslam_image_loss_destroy(void* workspace);

// Returns 0, or 1 when memory ran out. The caller has checked sizes and pointers.
GGSLAM_EXPORT int ggslam_image_loss_evaluate(void* context, void* workspace, ggslam::ImageLossJob* job);

// Chooses the pixels: `marks` and `pixels`; returns their number.
GGSLAM_EXPORT int64_t ggslam_insertion_select(void* context, ggslam::InsertionJob* job);
// Makes the Gaussians of the first `count` pixels that were chosen.
GGSLAM_EXPORT int ggslam_insertion_shape(void* context, const ggslam::InsertionJob* job, int64_t count);

// The result is the same, bit for bit, for any number of threads.
GGSLAM_EXPORT int ggslam_cross_entropy_of_pixels(void* context, ggslam::CrossEntropyOfPixels* job);

// Adds a view to the equations.
GGSLAM_EXPORT int ggslam_view_colors_add(void* context, const ggslam::ViewColorsOfView* job);
// Replaces right sides by the solutions, `ridge` being added to every diagonal; gains [gaussians]: by how much each lessens
// the weighted sum of squares, less what the ridge costs. Triangles stay.
GGSLAM_EXPORT int ggslam_view_colors_solve(void* context, float* equations, int64_t gaussians, int count, float ridge,
                                           float* gains);
