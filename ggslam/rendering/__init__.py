# SPDX-License-Identifier: Apache-2.0
"""Differentiable rendering of Gaussians: `render` for library users, `CpuRasterizer` for inner loops."""

from ggslam.rendering.adam import AdamSettings
from ggslam.rendering.api import backends, register_backend, render
from ggslam.rendering.cpu import CpuRasterizer, StepResult
from ggslam.rendering.types import Gaussians, GaussianTensors, Gradients, RenderBuffers

__all__ = [
    "AdamSettings",
    "CpuRasterizer",
    "GaussianTensors",
    "Gaussians",
    "Gradients",
    "RenderBuffers",
    "StepResult",
    "backends",
    "register_backend",
    "render",
]
