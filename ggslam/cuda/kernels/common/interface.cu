// SPDX-License-Identifier: Apache-2.0
#include "interface/cuda/common.hpp"

#include "common/platform.cuh"

#define GGSLAM_TEXT(macro) GGSLAM_TEXT_OF(macro)
#define GGSLAM_TEXT_OF(words) #words

GGSLAM_EXPORT const char* ggslam_cuda_interface_hash() { return GGSLAM_TEXT(GGSLAM_INTERFACE_HASH); }

GGSLAM_EXPORT const char* ggslam_cuda_error_text(int status) {
  return cudaGetErrorString(static_cast<cudaError_t>(status));
}
