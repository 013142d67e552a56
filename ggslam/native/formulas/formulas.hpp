// SPDX-License-Identifier: Apache-2.0
// How the formulas of this folder are declared: they are compiled by the core (its kernels once for each instruction set)
// and by the CUDA kernels. Formulas of Gaussians are stated for a Number, which is a vector of them in the core (rendering/kernels/
// numbers.hpp) and one float in a kernel (rendering/rules.cuh); those files define the functions of Numbers.
#pragma once

#ifdef GGSLAM_ISA
#define GGSLAM_FORMULAS ggslam::GGSLAM_ISA
#define GGSLAM_FORMULA static inline
#define GGSLAM_HOST_FORMULA static inline
#elif defined(__CUDACC__) || defined(GGSLAM_CUDA_EMULATION)
#include "common/platform.cuh"
#define GGSLAM_FORMULAS ggslam::cuda
#define GGSLAM_FORMULA __device__ inline
#define GGSLAM_HOST_FORMULA inline
#else
#define GGSLAM_FORMULAS ggslam::plain
#define GGSLAM_FORMULA static inline
#define GGSLAM_HOST_FORMULA static inline
#endif

namespace GGSLAM_FORMULAS {

GGSLAM_FORMULA float larger_of(float a, float b) { return a < b ? b : a; }
GGSLAM_FORMULA float smaller_of(float a, float b) { return b < a ? b : a; }

}  // namespace GGSLAM_FORMULAS
