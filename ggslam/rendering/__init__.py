# SPDX-License-Identifier: Apache-2.0
"""Differentiable rendering of Gaussians: `render` and `GaussianModel` for library users, `CpuRasterizer` and
`CudaRasterizer` for inner loops."""

from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.api import backends, choose_backend, register_backend, render
from ggslam.rendering.cpu import CpuRasterizer, CpuStepResult
from ggslam.rendering.cuda import CudaGradients, CudaRasterizer
from ggslam.rendering.losses import color_loss, depth_loss, identity_loss, neighbour_loss, ssim_map
from ggslam.rendering.model import GaussianModel
from ggslam.rendering.types import Gaussians, GaussianTensors, Gradients, RenderBuffers

__all__ = [
    "AdamSettings",
    "CpuRasterizer",
    "CpuStepResult",
    "CudaGradients",
    "CudaRasterizer",
    "GaussianModel",
    "GaussianTensors",
    "Gaussians",
    "Gradients",
    "RenderBuffers",
    "backends",
    "choose_backend",
    "color_loss",
    "depth_loss",
    "identity_loss",
    "neighbour_loss",
    "register_backend",
    "render",
    "ssim_map",
]
