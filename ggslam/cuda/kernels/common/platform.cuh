// SPDX-License-Identifier: Apache-2.0
// The one place that knows whether this is compiled by nvcc or, for tests, by a host compiler. With
// GGSLAM_CUDA_EMULATION, a header given on the command line defines the CUDA language and runtime used here.
#pragma once
#include <cstddef>
#include <cstdint>

#ifndef GGSLAM_CUDA_EMULATION
#include <cuda_runtime.h>

#define GGSLAM_SHARED __shared__

namespace ggslam::cuda {

// Starts kernel(arguments...) on `blocks` blocks of `threads` threads; errors are collected by cudaGetLastError.
template <class Kernel, class... Arguments>
void launch(Kernel kernel, std::int64_t blocks, int threads, cudaStream_t stream, const Arguments&... arguments) {
  if (blocks > 0) kernel<<<static_cast<unsigned>(blocks), threads, 0, stream>>>(arguments...);
}

// Marks, while it is there, what could be recorded as a graph: the emulation refuses what no graph holds.
struct CaptureRegion {
  CaptureRegion() {}
};

}  // namespace ggslam::cuda
#endif

namespace ggslam::cuda {

constexpr unsigned kAllLanes = 0xffffffffu;
constexpr int kWarp = 32;

}  // namespace ggslam::cuda
