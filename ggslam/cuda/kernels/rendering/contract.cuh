// SPDX-License-Identifier: Apache-2.0
// The rendering rules (stated in ggslam/rendering/reference.py) and the arguments of the C interface. GaussianArrays to
// GaussianGradients are laid out as in native/src/rendering/rasterizer.hpp; here their pointers lead to device memory.
#pragma once
#include "common/platform.cuh"

namespace ggslam::cuda {

constexpr float kLog2MinAlpha = -7.99435344f;  // log2(1 / 255): weaker contributions are skipped
constexpr float kMaxAlpha = 0.999f;
constexpr float kMinTransmittance = 1e-4f;  // a pixel takes no further Gaussian once its transmittance is below
constexpr float kFrustumMargin = 0.15f;     // of the image size: slopes beyond are clamped in the Jacobian
constexpr float kMaxDepth = 1e6f;           // metres; Gaussians farther away are skipped
constexpr float kMinLogScale = -23.0f, kMaxLogScale = 10.0f;
constexpr float kMinQuaternionNorm2 = 1e-20f, kMaxQuaternionNorm2 = 1e20f;
constexpr float kFinite = 1e30f;  // numbers beyond count as not finite
constexpr float kLog2E = 1.44269504f, kLn2 = 0.69314718f;

struct GaussianArrays {
  std::int64_t count;
  const float *means, *quaternions, *log_scales, *opacity_logits, *sh, *features;
  std::int32_t sh_coefficients;         // coefficients stored per Gaussian: 1, 4, 9 or 16
  std::int32_t active_sh_coefficients;  // how many of them are evaluated
  std::int32_t feature_channels;        // channels stored per Gaussian
  std::int32_t render_features;         // 0: leave them out
};

struct View {
  std::int32_t width, height;
  float fx, fy, cx, cy, near_plane;
  float low_pass;          // pixels^2 added to both diagonal terms of the 2D covariance
  float camera_world[12];  // first three rows of T_camera_world; see Rendering's pose
};

struct RenderTargets {  // planes [H, W]; features and median_depth may be null
  float *image, *features, *depth, *alpha, *median_depth;
};

struct ImageGradients {  // each may be null, which means zero
  const float *image, *features, *depth, *alpha;
  std::int32_t detach_features;  // 1: gradients of the feature channels reach the features only
};

struct GaussianGradients {  // gradient arrays may all be null; twist and touched are always written
  float *means, *quaternions, *log_scales, *opacity_logits, *sh, *features;
  double* twist;
  std::uint8_t* touched;
};

// One rendering: what to render, where to, and the device memory to work in (see workspace.cuh).
struct Rendering {
  GaussianArrays gaussians;
  View view;
  const float* pose;  // camera_world on the device, unchanged until all that was started is done; null: the view's own
  RenderTargets targets;
  void *gaussian_workspace, *pair_workspace, *pixel_workspace;
  std::int64_t pair_capacity;  // pairs of a Gaussian and a tile that pair_workspace has room for
  std::int64_t gaussian_sorting_bytes, pair_sorting_bytes;  // scratch for sorting, as set by ggslam_cuda_plan
  std::int32_t* overflowed;  // on the device, [1]: becomes 1 if there was too little room for pairs, else 0
  std::int64_t* overflows;   // on the device, [1]: then becomes one more; may be null
  void* stream;
  std::int32_t device;
};

}  // namespace ggslam::cuda
