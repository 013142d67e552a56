// SPDX-License-Identifier: Apache-2.0
// From each Gaussian's row of image-space gradients to the gradients of its parameters and of the camera pose, or to
// parameters that have made a step of Adam, without writing a gradient.
#pragma once
#include "rendering/adam.cuh"
#include "rendering/composite_backward.cuh"
#include "rendering/projection.cuh"
#include "native/formulas/projection_backward.hpp"
#include "rendering/view_colour.cuh"
#include "common/warp_reduction.cuh"

namespace ggslam::cuda {

constexpr int kGatherThreads = 256;
constexpr int kGatherBlocks = 1024;  // at most: each adds to the twist once per warp

// Zeroes the rows of the Gaussians that were rendered, four floats per thread. A block takes kGatherThreads rows.
__global__ void __launch_bounds__(kGatherThreads)
clear_rows_kernel(std::int64_t count, const std::uint32_t* tile_counts, GradientRows out) {
  const std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * kGatherThreads;
  const int quads = out.stride / 4;
  for (int k = threadIdx.x; k < kGatherThreads * quads; k += kGatherThreads) {
    const std::int64_t row = first + k / quads;
    if (row < count && tile_counts[row] != 0)
      reinterpret_cast<float4*>(out.rows + row * out.stride)[k % quads] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
  }
}

// Copies the features' columns; rows of Gaussians that were not touched become zero. A block takes kGatherThreads rows.
__global__ void __launch_bounds__(kGatherThreads)
gather_features_kernel(std::int64_t count, int channels, GradientRows in, float* features) {
  const std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * kGatherThreads;
  for (int k = threadIdx.x; k < kGatherThreads * channels; k += kGatherThreads) {
    const std::int64_t row = first + k / channels;
    if (row < count)
      features[row * channels + k % channels] =
          in.touched[row] != 0 ? in.rows[row * in.stride + kBaseGradients + k % channels] : 0.0f;
  }
}

// Steps the features of the Gaussians that were touched; their updates are counted already. A block takes
// kGatherThreads rows.
__global__ void __launch_bounds__(kGatherThreads)
step_features_kernel(std::int64_t count, int channels, GradientRows in, AdamStep adam) {
  const std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * kGatherThreads;
  for (int k = threadIdx.x; k < kGatherThreads * channels; k += kGatherThreads) {
    const std::int64_t row = first + k / channels;
    if (row >= count || in.touched[row] == 0) continue;
    const AdamFactors factors = adam_factors(adam, adam.updates[row]);
    step_parameter(adam, adam.features, row * channels + k % channels,
                   in.rows[row * in.stride + kBaseGradients + k % channels], step_size(adam, factors, kFeatures),
                   factors.correction);
  }
}

// What becomes of the gradients of a Gaussian: they are written,
struct WriteGradients {
  GaussianGradients out;

  __device__ void operator()(const GaussianArrays& arrays, std::int64_t row, bool, const ParameterGradients& g,
                             const float basis[16], const float colour[3]) const {
    if (out.means == nullptr) return;
    for (int k = 0; k < 3; ++k) out.means[3 * row + k] = g.mean[k];
    for (int k = 0; k < 4; ++k) out.quaternions[4 * row + k] = g.quaternion[k];
    for (int k = 0; k < 3; ++k) out.log_scales[3 * row + k] = g.log_scale[k];
    out.opacity_logits[row] = g.opacity_logit;
    float* sh = out.sh + row * arrays.sh_coefficients * 3;
#pragma unroll
    for (int k = 0; k < 16; ++k)
      if (k < arrays.sh_coefficients)
        for (int channel = 0; channel < 3; ++channel) sh[3 * k + channel] = basis[k] * colour[channel];
  }
};

// or the Gaussian steps along them.
struct StepParameters {
  AdamStep adam;

  __device__ void operator()(const GaussianArrays& arrays, std::int64_t row, bool touched, const ParameterGradients& g,
                             const float basis[16], const float colour[3]) const {
    if (!touched) return;
    const std::int32_t update = adam.updates[row] + 1;
    adam.updates[row] = update;
    const AdamFactors factors = adam_factors(adam, update);
    step_group<3>(adam.means, 3 * row, g.mean, factors, kMeans);
    step_group<4>(adam.quaternions, 4 * row, g.quaternion, factors, kQuaternions);
    step_group<3>(adam.log_scales, 3 * row, g.log_scale, factors, kLogScales);
    step_group<1>(adam.opacity_logits, row, &g.opacity_logit, factors, kOpacityLogits);
#pragma unroll
    for (int k = 0; k < 16; ++k) {
      if (k >= arrays.sh_coefficients) continue;
      const float gradient[3] = {basis[k] * colour[0], basis[k] * colour[1], basis[k] * colour[2]};
      step_group<3>(adam.sh, 3 * (row * arrays.sh_coefficients + k), gradient, factors, k == 0 ? kShConstant : kShRest);
    }
  }

  template <int kWidth>
  __device__ void step_group(const AdamArrays& arrays, std::int64_t first, const float* gradient,
                             const AdamFactors& factors, AdamGroup group) const {
    const float step = step_size(adam, factors, group);
#pragma unroll
    for (int k = 0; k < kWidth; ++k) step_parameter(adam, arrays, first + k, gradient[k], step, factors.correction);
  }
};

__device__ inline SplatGradients load_row(const GradientRows& in, std::int64_t row) {
  const float* v = in.rows + row * in.stride;
  return {v[0], v[1], v[2], v[3], v[4], v[5], {v[6], v[7], v[8]}, v[9]};
}

// twist is added to; it must be zero before.
template <class Finish>
__global__ void __launch_bounds__(kGatherThreads)
gather_kernel(GaussianArrays arrays, ViewConstants view, const float* pose, GradientRows in, double* out_twist,
              Finish finish) {
  GGSLAM_SHARED ViewConstants c;  // as private variables its pose would take more registers than there are
  if (threadIdx.x == 0) {
    c = view;
    read_pose(pose, c);
  }
  __syncthreads();
  const int lane = threadIdx.x % kWarp;
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kGatherThreads;
  double twist = 0.0;  // lane k < 6: component k, of the warp
  // Rounded up to whole warps: all lanes take part in the sums.
  const std::int64_t rounds_end = (arrays.count + kWarp - 1) / kWarp * kWarp;
  for (std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * kGatherThreads + threadIdx.x; row < rounds_end;
       row += stride) {
    const bool touched = row < arrays.count && in.touched[row] != 0;
    ParameterGradients g = {};
    float basis[16] = {}, colour[3] = {};
    if (touched) {
      const RawGaussian raw = load_gaussian(arrays, row);
      const Projection p = project(c, raw);
      const SplatGradients splat = load_row(in, row);
      float direction_gradient[3];
      for (int k = 0; k < 3; ++k) colour[k] = splat.colour[k];
      differentiate_cut_at_black(arrays, c, row, p.position, colour);
      differentiate_view_colour(arrays, c, row, p.position, colour, basis, direction_gradient);
      g = differentiate_projection(c, raw, p, splat, direction_gradient);
    }
    if (row < arrays.count) finish(arrays, row, touched, g, basis, colour);
    if (__ballot_sync(kAllLanes, touched) != 0) twist += static_cast<double>(sum_over_warp(g.twist, lane));
  }
  if (lane < 6) atomicAdd(out_twist + lane, twist);
}

}  // namespace ggslam::cuda
