// SPDX-License-Identifier: Apache-2.0
// The compiled core's rasterizer, sampled compositing (which Gaussians make up a pixel) and pictures of meshes.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/export.hpp"

namespace ggslam {

// Parameters of Gaussians, and what of them is rendered.
struct GaussianArrays {
  std::int64_t count;
  const float *means, *quaternions, *log_scales, *opacity_logits, *sh, *features;
  std::int32_t sh_coefficients;         // coefficients stored per Gaussian: 1, 4, 9 or 16
  std::int32_t active_sh_coefficients;  // how many of them are evaluated
  std::int32_t feature_channels;        // channels stored per Gaussian
  std::int32_t render_features;         // 0: leave them out
};

// A camera and its pose.
struct CameraView {
  std::int32_t width, height;
  float fx, fy, cx, cy, near_plane;
  float low_pass;  // pixels^2 added to both diagonal terms of the 2D covariance
  float close_below;  // transmittance below which a pixel is closed; 0: none is
  float camera_world[12];  // first three rows of T_camera_world
};

// Images to write, planes [H, W]; features and median_depth may be null.
struct RenderTargets {
  float *image, *features, *depth, *alpha, *median_depth;
};

// Gradients of a loss with respect to the images; each may be null, which means zero.
struct ImageGradients {
  const float *image, *features, *depth, *alpha;
  std::int32_t detach_features;  // 1: gradients of the feature channels reach the features only
};

// Gradients to write. The arrays may all be null; twist and touched are always written.
struct GaussianGradients {
  float *means, *quaternions, *log_scales, *opacity_logits, *sh, *features;
  double* twist;
  std::uint8_t* touched;
};

// A parameter array and its two moments.
struct AdamArrays {
  float *parameters, *first_moments, *second_moments;
};

// What the optimizer that is fused into the backward pass works on; the schedule is that of
// AdamSettings.schedule (ggslam/rendering/adam.py).
struct AdamArguments {
  AdamArrays means, quaternions, log_scales, opacity_logits, sh, features;
  std::int32_t* updates;
  const float* schedule;
  std::int32_t schedule_rows;
  float beta1, beta2, epsilon;
};

// The terms of P pixels: the first counts[p] of row p are in use, front to back.
struct PixelTerms {
  std::int64_t pixels;
  std::int32_t capacity;        // terms a row has room for
  std::int32_t* gaussians;      // [P, capacity]
  float* weights;               // [P, capacity]
  std::int32_t* counts;         // [P]
};

// Features of Gaussians and their optimizer.
struct FeatureAdam {
  std::int64_t gaussians;
  float *features, *first_moments, *second_moments;  // [N, channels]
  std::int32_t* updates;        // [N]
  const float* schedule;        // [rows][2]: step size over bias correction, 1 / sqrt of the second correction
  std::int32_t schedule_rows, channels;
  float beta1, beta2, epsilon;
  // If not null, the first moments as bfloat16 [N, channels]; second_moments are then means over the channels [N], and
  // first_moments are not used.
  std::uint16_t* short_moments;
};

// Votes of Gaussians, and the labels that pixels give them.
struct TermVotes {
  const std::uint16_t* labels;  // [P]; 0 votes for nothing
  const float* pixel_weights;   // [P], or null: 1 each
  std::int32_t* ids;            // [N, slots]
  float* weights;               // [N, slots]
  std::int32_t slots;
};

// A mesh and a camera. Positions [vertices, 3] in the camera's axes, colours [vertices, 3] as they are to be seen; triangles
// [triangles, 3], counter-clockwise seen from their front.
struct MeshPictureInput {
  const float* positions;
  const uint8_t* colors;
  const int32_t* triangles;
  int64_t vertices, count;
  float fx, fy, cx, cy, near;
  int32_t width, height;
  int32_t cull;  // triangles seen from behind are left out
};

}  // namespace ggslam

// The context must live as long as the rasterizer.
GGSLAM_EXPORT void* ggslam_rasterizer_create(void* context);
GGSLAM_EXPORT int ggslam_rasterizer_destroy(void* rasterizer);

// Renders. Returns 0, 1 (out of memory) or 2 (more than 2^31 pairs of a Gaussian and a tile). as_3dgs: with 3DGS's limit of
// alpha and its end of a pixel, without features and median depth; there is no backward then.
GGSLAM_EXPORT int ggslam_rasterizer_forward(void* rasterizer, const ggslam::GaussianArrays* gaussians,
                                            const ggslam::CameraView* view, const ggslam::RenderTargets* targets,
                                            int as_3dgs);

// Differentiates the last forward, whose arrays must still be there and unchanged. With `adam`, updates the Gaussians
// that were touched instead of writing their gradients.
GGSLAM_EXPORT int ggslam_rasterizer_backward(void* rasterizer, const ggslam::ImageGradients* image_gradients,
                                             const ggslam::GaussianGradients* gradients,
                                             const ggslam::AdamArguments* adam);

// Numbers of the last forward: visible Gaussians, pairs of a Gaussian and a tile.
GGSLAM_EXPORT int ggslam_rasterizer_statistics(void* rasterizer, std::int64_t* out);

// Fills `out` for pixels (row * width + column, each within the image) of the last forward, leaving out contributions
// below min_weight and those for which a row has no room. Returns 0 or 1 (out of memory).
GGSLAM_EXPORT int ggslam_rasterizer_pixel_terms(void* rasterizer, const std::int32_t* pixels, float min_weight,
                                                const ggslam::PixelTerms* out);

// Sets `shown` [gaussians] to 1 for those that make up a share of min_weight of any pixel of the last forward, which was
// of so many; leaves the others.
GGSLAM_EXPORT int ggslam_rasterizer_shown(void* rasterizer, float min_weight, std::int64_t gaussians,
                                          std::uint8_t* shown);

// out [P, channels] = sum of weight times feature [gaussians, channels]. Returns 0.
GGSLAM_EXPORT int ggslam_terms_blend(void* context, const ggslam::PixelTerms* terms, const float* features,
                                     std::int64_t gaussians, int channels, float* out);

// Adam on the features of the Gaussians in `terms`, their gradient being the sum of weight times gradient [P, channels].
// Returns 0 or 1 (out of memory).
GGSLAM_EXPORT int ggslam_terms_step(void* context, const ggslam::PixelTerms* terms, const float* gradient,
                                    const ggslam::FeatureAdam* adam);

// Adds each pixel's weights, times those of the pixels [P] (null: 1), to the votes [gaussians, slots] of its Gaussians
// under labels [P]; label 0 votes for nothing. Returns 0 or 1 (out of memory).
GGSLAM_EXPORT int ggslam_terms_vote(void* context, const ggslam::PixelTerms* terms, const std::uint16_t* labels,
                                    const float* pixel_weights, std::int64_t gaussians, int slots, std::int32_t* ids,
                                    float* weights);

// Both on one set of terms: Adam on the features, and the votes. Returns 0 or 1 (out of memory).
GGSLAM_EXPORT int ggslam_terms_learn(void* context, const ggslam::PixelTerms* terms, const float* gradient,
                                     const ggslam::FeatureAdam* adam, const ggslam::TermVotes* votes);

// The label with the largest rendering weight at each pixel, and its share of the pixel's weight. `labels` [gaussians].
GGSLAM_EXPORT int ggslam_terms_label(void* context, const ggslam::PixelTerms* terms, const std::uint16_t* labels,
                                     std::int64_t gaussians, std::uint16_t* ids, float* shares);

// Draws on what stands in `picture` [height, width, 3]; `inverse_z` [height, width] must be 0 at first.
GGSLAM_EXPORT int ggslam_draw_mesh(void* context, const ggslam::MeshPictureInput* in, float* inverse_z,
                                   uint8_t* picture);
