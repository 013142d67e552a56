// SPDX-License-Identifier: Apache-2.0
#pragma once
#include "common/platform.cuh"
#include "abi/cuda/sight.hpp"

namespace ggslam::cuda {

// Starts to make a view, to compare it, and to copy what was found to the host.
cudaError_t launch_mover_evidence(const MoverEvidenceJob& job, cudaStream_t stream);

}  // namespace ggslam::cuda
