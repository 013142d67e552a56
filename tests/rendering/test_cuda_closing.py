# SPDX-License-Identifier: Apache-2.0
"""Pixels that end on a device when little of their light is left, as in the compiled core."""

from __future__ import annotations

import torch
from cuda_emulation import emulated_library
from rendering_scenes import CAMERA, POSE, relative_error
from test_fused_adam import make_map

from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.rendering.types import PARAMETERS
from ggslam.scene.gaussian_map import GaussianMap


def crowd() -> GaussianMap:
    """Of large, opaque Gaussians one behind the other."""
    gaussians = make_map(0, 4)
    gaussians.log_scales.add_(0.7)
    gaussians.opacity_logits.add_(2.0)
    return gaussians


def test_pixels_are_closed_as_in_the_compiled_core() -> None:
    gaussians, cpu, device = crowd(), CpuRasterizer(1), CudaRasterizer(library=emulated_library())
    device.close_below = 0.3
    theirs = cpu.forward(gaussians, CAMERA, POSE, close_below=0.3)
    ours = device.forward(gaussians, CAMERA, POSE)
    closed = (theirs.alpha > 0.9989).float().mean()
    assert 0.2 < closed < 1.0 and theirs.features is not None and ours.features is not None
    for name in ("image", "depth", "alpha", "features"):
        assert (getattr(ours, name) - getattr(theirs, name)).abs().max() < 1e-4, name
    random = torch.Generator().manual_seed(0)
    grads = [torch.randn(shape, generator=random) for shape in (ours.image.shape, ours.depth.shape, ours.alpha.shape)]
    grads.append(torch.randn(ours.features.shape, generator=random))
    found, expected = device.backward(*grads), cpu.backward(*grads)
    for name in PARAMETERS:
        assert relative_error(getattr(found, name), getattr(expected, name)) < 1e-3, name
    assert torch.equal(found.touched, expected.touched)
    pixels = torch.arange(ours.alpha.numel(), dtype=torch.int32)
    terms, known = device.pixel_terms(pixels), cpu.pixel_terms(pixels.numpy())
    assert (terms.opacity() - ours.alpha.view(-1)).abs().max() < 0.05  # without what is fainter than 0.001
    assert (terms.features(gaussians) - torch.from_numpy(known.features(gaussians))).abs().max() < 1e-3


def test_without_closing_nothing_changes() -> None:
    gaussians, one, other = crowd(), *(CudaRasterizer(library=emulated_library()) for _ in range(2))
    other.close_below = 1e-30
    views = [rasterizer.forward(gaussians, CAMERA, POSE) for rasterizer in (one, other)]
    assert torch.equal(views[0].image, views[1].image) and torch.equal(views[0].alpha, views[1].alpha)
