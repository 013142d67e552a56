// SPDX-License-Identifier: Apache-2.0
// What all parts of the CUDA kernels share: their version, the text of an error.
#pragma once
#include "interface/export.hpp"

// SHA-256 of the headers in interface/core and interface/cuda that the kernels were compiled with.
GGSLAM_EXPORT const char* ggslam_cuda_interface_hash();

GGSLAM_EXPORT const char* ggslam_cuda_error_text(int status);
