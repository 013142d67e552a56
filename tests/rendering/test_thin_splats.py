# SPDX-License-Identifier: Apache-2.0
"""Gradients of long, thin splats keep their digits: errors against float64 from 0.3 to 300 pixels, at every shape."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from cuda_contract import emulated_rasterizer

from ggslam.native.loader import available_instruction_sets
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts" / "benchmarks"))
from bench_gradients import NAMES, make_splat, reference_gradients  # noqa: E402

CAMERA = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)
LENGTHS = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Standard deviations in the image along the longest axis, pixels."""
DRAWS = 5


@pytest.mark.parametrize("aspect", [2.0, 10.0, 100.0, 1000.0])
@pytest.mark.parametrize("backend", [*available_instruction_sets(), "cuda"])
def test_gradients_keep_their_digits(backend: str, aspect: float) -> None:
    rasterizer = emulated_rasterizer() if backend == "cuda" else CpuRasterizer(1, backend)
    random = np.random.default_rng(0)
    for length in LENGTHS:
        errors: dict[str, list[float]] = {name: [] for name in NAMES}
        for _ in range(DRAWS):
            splat = make_splat(length, aspect, CAMERA, random)
            gradient = torch.from_numpy(random.normal(0, 1, (3, CAMERA.height, CAMERA.width)).astype(np.float32))
            rasterizer.forward(splat, CAMERA, np.eye(4))
            found = rasterizer.backward(gradient)
            for name, exact in reference_gradients(splat, CAMERA, gradient, torch.float64).items():
                errors[name].append(float((getattr(found, name).double() - exact).norm() / exact.norm()))
        for name, values in errors.items():
            # A pixel whose alpha lies within rounding of 1/255 may count in one precision only: hence the median.
            assert np.median(values) < 5e-4, f"{name} at {length} px: {values}"
