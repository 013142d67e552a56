# SPDX-License-Identifier: Apache-2.0
"""The rendering contract as the CUDA rasterizer is held to it, emulated on the CPU or on a GPU."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from cuda_emulation import emulated_library
from rendering_scenes import (
    CAMERA,
    POSE,
    ImageGradients,
    make_image_gradients,
    make_scene,
    reference_gradients,
    relative_error,
)

from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.types import PARAMETERS, GaussianTensors
from ggslam.scene.camera import Camera

IMAGES = ("image", "depth", "alpha", "features", "median_depth")
FORWARD_TOLERANCE = 1e-5
BACKWARD_TOLERANCE = 1e-5
BORDERLINE_TOLERANCE = 1e-2


def emulated_rasterizer(**options: float) -> CudaRasterizer:
    """A rasterizer whose device is the CPU."""
    return CudaRasterizer("cpu", library=emulated_library(), **options)


def moved(tensors: Any, device: torch.device) -> Any:
    """A dataclass of tensors (or None) on another device."""
    fields = {name: None if value is None else value.to(device) for name, value in vars(tensors).items()}
    return dataclasses.replace(tensors, **fields)


def on_cpu(results: Any) -> dict[str, torch.Tensor]:
    """Copies of the tensors of a dataclass, without those that are None."""
    return {name: torch.as_tensor(value).cpu().clone() for name, value in vars(results).items() if value is not None}


def run(
    rasterizer: CudaRasterizer | CpuRasterizer,
    scene: GaussianTensors,
    camera: Camera,
    pose: np.ndarray,
    gradients: ImageGradients,
    **options: Any,
) -> dict[str, torch.Tensor]:
    """Images and gradients, on the CPU."""
    device = getattr(rasterizer, "device", torch.device("cpu"))
    detach = options.pop("detach_features", False)
    rendered = rasterizer.forward(moved(scene, device), camera, pose, **options)
    images = {f"rendered_{name}": value for name, value in on_cpu(rendered).items()}
    found = rasterizer.backward(*moved(gradients, device).arguments(), detach_features=detach)
    return images | on_cpu(found)


def assert_agrees(
    found: dict[str, torch.Tensor],
    expected: dict[str, torch.Tensor],
    tolerance: float,
    borderline_tolerance: float = BORDERLINE_TOLERANCE,
) -> None:
    """Images to 1e-5 of their values, gradients to a relative tolerance, flags exactly.

    Rounding decides whether a contribution of just 1/255 is taken: one pixel in a thousand may differ by such a
    contribution, and if one does, gradients are held to the other tolerance.
    """
    assert found.keys() == expected.keys()
    borderline = 0
    for name, value in expected.items():
        if name.startswith("rendered_"):
            error = (found[name] - value).abs() / value.abs().clamp_min(1.0)
            differing = int((error >= FORWARD_TOLERANCE).reshape(-1, *value.shape[-2:]).any(0).sum())
            assert differing <= value.shape[-2] * value.shape[-1] / 1000, name
            assert not value.numel() or float(error.max()) < 1 / 200, name
            borderline = max(borderline, differing)
    assert int((found["touched"] != expected["touched"]).sum()) <= borderline
    for name, value in expected.items():
        if value.numel() and value.is_floating_point() and not name.startswith("rendered_"):
            assert relative_error(found[name], value) < (borderline_tolerance if borderline else tolerance), name


def check_against_cpu(
    rasterizer: CudaRasterizer,
    scene: GaussianTensors,
    camera: Camera = CAMERA,
    pose: np.ndarray = POSE,
    tolerance: float = BACKWARD_TOLERANCE,
    borderline_tolerance: float = BORDERLINE_TOLERANCE,
    **options: Any,
) -> dict[str, torch.Tensor]:
    """Renders and differentiates on both; returns what the CUDA rasterizer found."""
    channels = scene.features.shape[1] if options.get("features", True) else 0
    gradients = make_image_gradients(camera, channels)
    cpu = CpuRasterizer(1, near_plane=rasterizer.near_plane, low_pass=rasterizer.low_pass)
    expected = run(cpu, scene, camera, pose, gradients, **options)
    found = run(rasterizer, scene, camera, pose, gradients, **options)
    assert_agrees(found, expected, tolerance, borderline_tolerance)
    return found


def check_against_reference(rasterizer: CudaRasterizer, scene: GaussianTensors, tolerance: float) -> None:
    """Images and gradients against float64 autograd."""
    gradients = make_image_gradients(CAMERA, scene.features.shape[1])
    rendered, expected = reference_gradients(scene, CAMERA, POSE, gradients)
    found = run(rasterizer, scene, CAMERA, POSE, gradients)
    for name in ("image", "depth", "alpha"):
        assert relative_error(found[f"rendered_{name}"], getattr(rendered, name)) < FORWARD_TOLERANCE, name
    for name in (*PARAMETERS, "twist"):
        if name in found and found[name].numel():
            assert relative_error(found[name], expected[name]) < tolerance, name


def crowded_scene(features: int) -> GaussianTensors:
    """Long lists per tile, saturated pixels, equal depths, and some Gaussians that cover many tiles."""
    scene = make_scene(1500, features)
    scene.opacity_logits += 1.0
    scene.means[:400, 2] = 1.5
    scene.log_scales[400:420] += 3.0
    return scene
