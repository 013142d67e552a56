// SPDX-License-Identifier: Apache-2.0
// What all parts of the CUDA kernels share: their version, the text of an error.
#pragma once
#include <cstddef>

#include "abi/export.hpp"

// SHA-256 of the headers in abi/core and abi/cuda that the kernels were compiled with.
GGSLAM_EXPORT const char* ggslam_cuda_abi_hash();

// Bytes of each structure in the headers in abi/cuda, in their order; `count` receives how many there are.
GGSLAM_EXPORT const std::size_t* ggslam_cuda_structure_sizes(int* count);

GGSLAM_EXPORT const char* ggslam_cuda_error_text(int status);
