// SPDX-License-Identifier: Apache-2.0
// The formulas that CPU and GPU share, for one Gaussian per thread: see ggslam/native/formulas.
#pragma once
#include "common/platform.cuh"
#include "abi/cuda/rendering.hpp"
#include "native/formulas/formulas.hpp"
#include "native/formulas/rendering_rules.hpp"

namespace ggslam::cuda {

using Number = float;
using Verdict = bool;

__device__ inline float broadcast(float x) { return x; }
__device__ inline float maximum(float a, float b) { return fmaxf(a, b); }
__device__ inline float clamp(float x, float low, float high) { return fminf(fmaxf(x, low), high); }
__device__ inline float absolute(float x) { return fabsf(x); }
__device__ inline float square_root(float x) { return sqrtf(x); }
__device__ inline float exponential(float x) { return expf(x); }
__device__ inline float sigmoid(float x) { return 1.0f / (1.0f + expf(-x)); }
__device__ inline bool greater(float a, float b) { return a > b; }
__device__ inline bool greater_equal(float a, float b) { return a >= b; }
__device__ inline bool both(bool a, bool b) { return a && b; }
__device__ inline float zero_unless(bool condition, float x) { return condition ? x : 0.0f; }

}  // namespace ggslam::cuda
