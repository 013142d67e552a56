// SPDX-License-Identifier: Apache-2.0
#include "abi/cuda/common.hpp"
#include "abi/cuda/growth.hpp"
#include "abi/cuda/mapping.hpp"
#include "abi/cuda/rendering.hpp"
#include "abi/cuda/sampled_identity.hpp"
#include "abi/cuda/seen_map.hpp"
#include "abi/cuda/sight.hpp"
#include "abi/cuda/tracked_features.hpp"
#include "abi/cuda/tracking.hpp"
#include "abi/cuda/training.hpp"
#include "abi/cuda/volumes.hpp"

#include "common/platform.cuh"

GGSLAM_EXPORT const char* ggslam_cuda_abi_hash() { return GGSLAM_TEXT(GGSLAM_ABI_HASH); }

GGSLAM_EXPORT const std::size_t* ggslam_cuda_structure_sizes(int* count) {
  using namespace ggslam::cuda;
  using Sizes = ggslam::SizesOf<GGSLAM_STRUCTURES>;
  *count = Sizes::count;
  return Sizes::bytes;
}

GGSLAM_EXPORT const char* ggslam_cuda_error_text(int status) {
  return cudaGetErrorString(static_cast<cudaError_t>(status));
}
