// SPDX-License-Identifier: Apache-2.0
// The formulas of volumes that CPU and GPU share, for one voxel per thread: see ggslam/native/formulas.
#pragma once
#include "common/platform.cuh"
#include "abi/cuda/volumes.hpp"
#include "native/formulas/formulas.hpp"
#include "native/formulas/tsdf_rules.hpp"

namespace ggslam::cuda {

using volumes::kSide;
using volumes::kVoxels;

using Float = float;
using Int = std::int32_t;
using Mask = bool;

__device__ inline float broadcast(float x) { return x; }
__device__ inline std::int32_t broadcast_int(std::int32_t x) { return x; }
__device__ inline float to_float(std::int32_t x) { return static_cast<float>(x); }
__device__ inline std::int32_t truncate(float x) { return __float2int_rz(x); }
__device__ inline float minimum(float a, float b) { return a < b ? a : b; }
__device__ inline float maximum(float a, float b) { return a > b ? a : b; }
__device__ inline float absolute(float x) { return fabsf(x); }
__device__ inline float square_root(float x) { return sqrtf(x); }
__device__ inline bool greater(float a, float b) { return a > b; }
__device__ inline bool greater_equal(float a, float b) { return a >= b; }
__device__ inline bool both(bool a, bool b) { return a && b; }
__device__ inline bool either(bool a, bool b) { return a || b; }
__device__ inline bool neither_of(bool a, bool b) { return a && !b; }
__device__ inline bool any(bool m) { return m; }
__device__ inline float select(bool m, float a, float b) { return m ? a : b; }
__device__ inline float zero_unless(bool m, float x) { return m ? x : 0.0f; }
__device__ inline float gather(const float* p, std::int32_t at) { return p[at]; }
__device__ inline void gather_pairs(const float* p, std::int32_t at, float& first, float& second) {
  first = p[at], second = p[at + 1];
}

__device__ inline float product_sum(float a, float b, float c) { return a * b + c; }
__device__ inline float inverse_root(float a) { return rsqrtf(a); }
__device__ inline float signed_as(float a, float b) { return copysignf(a, b); }

}  // namespace ggslam::cuda
