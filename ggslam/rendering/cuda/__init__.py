# SPDX-License-Identifier: Apache-2.0
"""The rasterizer on NVIDIA GPUs: the rules and channels of the CPU rasterizer, compiled by nvcc when first used."""

from ggslam.cuda.availability import cuda_backend_problem
from ggslam.rendering.cuda.rasterizer import CudaGradients, CudaRasterizer

__all__ = ["CudaGradients", "CudaRasterizer", "cuda_backend_problem"]
