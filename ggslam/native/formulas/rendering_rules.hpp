// SPDX-License-Identifier: Apache-2.0
// The rendering rules: one contract for all backends, stated in ggslam/rendering/reference.py.
#pragma once

namespace ggslam {

constexpr float kLog2MinAlpha = -7.99435344f;  // log2(1 / 255): weaker contributions are skipped
constexpr float kMaxAlpha = 0.999f;
constexpr float kMaxAlphaOf3dgs = 0.99f;    // in pictures by the rules of 3DGS
constexpr float kMinTransmittance = 1e-4f;  // a pixel takes no further Gaussian once its transmittance is below
constexpr float kFrustumMargin = 0.15f;     // of the image size: slopes beyond are clamped in the Jacobian
constexpr float kMaxDepth = 1e6f;           // metres; Gaussians farther away are skipped
constexpr float kMinLogScale = -23.0f, kMaxLogScale = 10.0f;  // Gaussians with a scale outside are skipped
constexpr float kMinQuaternionNorm2 = 1e-20f, kMaxQuaternionNorm2 = 1e20f;
constexpr float kFinite = 1e30f;  // numbers beyond count as not finite
constexpr float kLog2E = 1.44269504f, kLn2 = 0.69314718f;

}  // namespace ggslam
