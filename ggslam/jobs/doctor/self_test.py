# SPDX-License-Identifier: Apache-2.0
"""A second's work that shows whether the compiled core, the renderer and the tracker work on this machine."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from ggslam.native.loader import available_instruction_sets
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam
from ggslam.system.tuning import Tuning

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
_STEP = np.array([0.02, -0.01, 0.015])
"""Metres that the camera moves between the two frames."""


class SelfTestTuning(Tuning):
    """The room that is tracked."""

    walls = ((0, 0.9), (0, -1.1), (1, 0.7), (1, -0.8), (2, 2.5))
    """Axis and place of the walls of a box around the camera, metres."""


def checks() -> dict[str, Callable[[], str]]:
    """The tests by name: each returns a few words when all is well and raises otherwise."""
    tests: dict[str, Callable[[], str]] = {}
    for name in available_instruction_sets():
        tests[f"render ({name})"] = lambda name=name: _render(name)  # type: ignore[misc]
    tests["track two frames"] = _track
    return tests


def _render(instruction_set: str) -> str:
    """Two Gaussians, one behind the other, whose colour in the middle of the image is known."""
    gaussians = GaussianMap(with_moments=False)
    gaussians.insert(
        torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0, 0, 0], [1.0, 0, 0, 0]]),
        torch.full((2, 3), -1.0), torch.logit(torch.tensor([0.6, 0.9])), torch.tensor([[1.0, 0, 0], [0, 1.0, 0]]),
    )  # fmt: skip
    camera = Camera(33, 25, 30.0, 30.0, 16.0, 12.0)
    view = CpuRasterizer(threads=1, instruction_set=instruction_set).forward(gaussians, camera, np.eye(4))
    found, expected = view.image[:, 12, 16], torch.tensor([0.6, 0.4 * 0.9, 0.0])
    if not torch.allclose(found, expected, atol=1e-3):
        raise ValueError(f"the middle of the image is {found.tolist()}, expected {expected.tolist()}")
    return "right colours"


def _track() -> str:
    """The camera moves by a known step in a box with patterned walls."""
    slam = Slam(CAMERA, load_config(None, ["mapping.iterations_per_frame=1", "identity.enabled=false"]))
    for index in range(2):
        slam.step(_frame(index))
    moved = slam.finish().trajectory()[1][:3, 3]
    error = float(np.linalg.norm(moved - _STEP))
    if not error < 0.005:
        raise ValueError(f"the camera moved by {_STEP.tolist()} m, found {moved.round(4).tolist()}")
    return f"pose off by {1000 * error:.1f} mm"


def _frame(index: int) -> Frame:
    place, rays = index * _STEP, CAMERA.rays().astype(np.float64)
    depth = np.full(rays.shape[:2], np.inf)
    for axis, wall in SelfTestTuning.walls:
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (wall - place[axis]) / rays[..., axis]
        depth = np.where(reach > 0, np.minimum(depth, reach), depth)
    points = rays * depth[..., None] + place
    pattern = np.sin(points * 9.0).sum(2, keepdims=True) + np.sin(points[..., [1, 2, 0]] * [5.0, 7.0, 11.0])
    color = (127.5 + 30 * pattern).clip(0, 255).astype(np.uint8)
    return Frame(index, index, index / 30, color, depth.astype(np.float32), CAMERA)
