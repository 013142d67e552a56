# SPDX-License-Identifier: Apache-2.0
"""Trains the Gaussians that close a hole on what the keyframes show beside it; all others stay as they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from ggslam.objects.hole_views import HoleView
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import Gradients
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.system.tuning import Tuning


class HoleTrainingTuning(Tuning):
    """How new Gaussians in a hole are trained."""

    rates = {"sh": 1e-2, "opacity_logits": 5e-2, "log_scales": 1e-2}
    """Adam's step sizes. Positions stay fixed: little is seen of most new Gaussians that would hold them."""
    depth_weight = 0.5
    """Weight of the depth error."""
    adam_epsilon = 0.5
    """Adam's epsilon: Gaussians with gradients of less than half a pixel's error move less. Without it, those that
    hardly show move as far as the others."""


@dataclass(frozen=True)
class Recorded:
    """Images of a frame: colour uint8 [H, W, 3] and depth float32 [H, W], metres, 0 = none."""

    color: np.ndarray
    depth: np.ndarray


def refine(
    gaussians: GaussianMap, first: int, views: Sequence[HoleView], recorded: Callable[[int], Recorded], iterations: int
) -> None:
    """Trains the rows from `first` on by L1 on colour and depth; pixels that the object covered have no say.

    Args:
        gaussians: the map; changed in place.
        first: row of the first new Gaussian.
        views: of the hole; those without a frame number are passed over.
        recorded: gives the images of a frame.
        iterations: steps, one view each.
    """
    known = [view for view in views if view.view.frame is not None]
    targets = [_Target.of(view, recorded(view.view.frame)) for view in known if view.view.frame is not None]
    new = {name: _trained_values(gaussians, name)[first:] for name in HoleTrainingTuning.rates}
    parameters = {name: values.clone().requires_grad_() for name, values in new.items()}
    groups = [{"params": [parameters[name]], "lr": rate} for name, rate in HoleTrainingTuning.rates.items()]
    optimizer = torch.optim.Adam(groups, eps=HoleTrainingTuning.adam_epsilon)
    rasterizer = CpuRasterizer()
    for i in range(iterations if targets else 0):
        target = targets[i % len(targets)]
        view = rasterizer.forward(gaussians, target.view.view.camera, target.view.view.T_camera_world, features=False)
        d_color = torch.sign(view.image - target.color) * target.free
        d_depth = HoleTrainingTuning.depth_weight * torch.sign(view.depth - target.depth) * target.measured
        gradients = rasterizer.backward(d_color, d_depth)
        for name, values in parameters.items():
            values.grad = _trained_values(gradients, name)[first:]
        optimizer.step()
        with torch.no_grad():
            for name, values in new.items():
                values.copy_(parameters[name])


def _trained_values(holder: GaussianMap | Gradients, name: str) -> torch.Tensor:
    """A parameter or its gradient; of colour the part that does not depend on the viewing direction."""
    values: torch.Tensor = getattr(holder, name)
    return values[:, :1] if name == "sh" else values


@dataclass(frozen=True)
class _Target:
    """A view with its images as tensors: colour [3, H, W], depth [H, W], and 1 where colour and depth count."""

    view: HoleView
    color: torch.Tensor
    depth: torch.Tensor
    free: torch.Tensor
    measured: torch.Tensor

    @staticmethod
    def of(view: HoleView, images: Recorded) -> _Target:
        free = cv2.dilate(view.covered.astype(np.uint8), np.ones((7, 7), np.uint8)) == 0
        color = np.ascontiguousarray(images.color.transpose(2, 0, 1), np.float32) / 255
        return _Target(
            view, torch.from_numpy(color), torch.from_numpy(images.depth.astype(np.float32)),
            torch.from_numpy(free.astype(np.float32)),
            torch.from_numpy((free & (images.depth > 0)).astype(np.float32)),
        )  # fmt: skip
