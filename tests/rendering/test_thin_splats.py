# SPDX-License-Identifier: Apache-2.0
"""Gradients of long, thin splats keep their digits: errors against float64 from 0.3 to 300 pixels, at every shape."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from cuda_contract import emulated_rasterizer

from ggslam.native.loader import available_instruction_sets
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.reference import render_reference
from ggslam.rendering.types import GaussianTensors
from ggslam.scene.camera import Camera

CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)
NAMES = ("log_scales", "quaternions", "means")
LENGTHS = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Standard deviations in the image along the longest axis, pixels."""
DRAWS = 5


def make_splat(length_px: float, aspect: float, random: np.random.Generator) -> GaussianTensors:
    """One Gaussian about the image's middle, turned at random about the optical axis and slightly out of the plane."""
    sigma, angle = length_px * 2.0 / CAMERA.fx, random.uniform(0, math.pi)
    quaternion = np.array([[math.cos(angle / 2), *random.normal(0, 0.1, 2), math.sin(angle / 2)]])
    log_scales = np.log([[sigma, sigma / aspect, sigma / aspect / 1.1]])
    means = np.array([[*random.uniform(-0.2, 0.2, 2), 2.0]])
    arrays = (means, quaternion, log_scales, np.array([0.5]), np.array([[[0.3, -0.2, 0.5]]]), np.zeros((1, 0)))
    return GaussianTensors(*(torch.tensor(a, dtype=torch.float32) for a in arrays))


def exact_gradients(splat: GaussianTensors, gradient: torch.Tensor) -> dict[str, torch.Tensor]:
    parts = {name: value.double().requires_grad_(name in NAMES) for name, value in vars(splat).items()}
    rendered = render_reference(GaussianTensors(**parts), CAMERA, torch.eye(4, dtype=torch.float64))
    (rendered.image * gradient.double()).sum().backward()
    return {name: parts[name].grad for name in NAMES}


@pytest.mark.parametrize("aspect", [2.0, 10.0, 100.0, 1000.0])
@pytest.mark.parametrize("backend", [*available_instruction_sets(), "cuda"])
def test_gradients_keep_their_digits(backend: str, aspect: float) -> None:
    rasterizer = emulated_rasterizer() if backend == "cuda" else CpuRasterizer(1, backend)
    random = np.random.default_rng(0)
    for length in LENGTHS:
        errors: dict[str, list[float]] = {name: [] for name in NAMES}
        for _ in range(DRAWS):
            splat = make_splat(length, aspect, random)
            gradient = torch.from_numpy(random.normal(0, 1, (3, CAMERA.height, CAMERA.width)).astype(np.float32))
            rasterizer.forward(splat, CAMERA, np.eye(4))
            found = rasterizer.backward(gradient)
            for name, exact in exact_gradients(splat, gradient).items():
                errors[name].append(float((getattr(found, name).double() - exact).norm() / exact.norm()))
        for name, values in errors.items():
            # A pixel whose alpha lies within rounding of 1/255 may count in one precision only: hence the median.
            assert np.median(values) < 5e-4, f"{name} at {length} px: {values}"
