// SPDX-License-Identifier: Apache-2.0
// What the functions of the C interface have in common.
#pragma once
#include "common/platform.cuh"

namespace ggslam::cuda {

inline std::int64_t blocks_for(std::int64_t count, int threads) { return (count + threads - 1) / threads; }

// Runs work on a device and reports what went wrong. The caller's current device stays what it was: torch shares it.
template <class Work>
int on_device(int device, const Work& work) {
  int before = device;
  cudaError_t chosen = cudaGetDevice(&before);
  if (chosen == cudaSuccess && before != device) chosen = cudaSetDevice(device);
  if (chosen != cudaSuccess) return chosen;
  const cudaError_t status = work(), launched = cudaGetLastError();
  if (before != device) cudaSetDevice(before);
  return status != cudaSuccess ? status : launched;
}

}  // namespace ggslam::cuda
