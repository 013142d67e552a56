# SPDX-License-Identifier: Apache-2.0
"""Closes what planes leave open: depth and colour are continued in a view's image and put back into space."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ggslam.objects.hole_views import HoleView, HoleViewTuning, could_be_hidden
from ggslam.objects.plane_filling import discs
from ggslam.objects.texture import fill_gap
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.rendering.types import Gaussians, GaussianTensors
from ggslam.system.tuning import Tuning


class ViewFillingTuning(Tuning):
    """How gaps in a view are filled."""

    min_pixels = 6
    """Smaller gaps are left alone, in pixels."""
    depth_factors = (1.0, 1.03, 1.07, 1.12, 1.2, 1.33)
    """Factors of depth that are tried for a new surface."""


def open_pixels(kept: Gaussians, view: HoleView) -> np.ndarray:
    """Pixels of the object that show nothing solid now, bool [H, W]: the black blots."""
    out = CpuRasterizer().forward(kept, view.view.camera, view.view.T_camera_world, features=False)
    covered = cv2.dilate(view.covered.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return covered & (out.alpha.numpy() < HoleViewTuning.solid)


def close(kept: Gaussians, view: HoleView, views: Sequence[HoleView]) -> GaussianTensors | None:
    """Gaussians for the open pixels of a view; None if there are none or nothing may be put there.

    Args:
        kept: the map without the object, with what was filled so far.
        view: the view to mend.
        views: all views of the hole: nothing is put where one of them saw empty space.
    """
    gap = open_pixels(kept, view)
    camera, T = view.view.camera, view.view.T_camera_world
    out = CpuRasterizer().forward(kept, camera, T, features=False)
    alpha, depth = out.alpha.numpy(), out.expected_depth.numpy()
    known = (alpha >= HoleViewTuning.solid) & ~view.covered & ~gap
    if gap.sum() < ViewFillingTuning.min_pixels or not known.any():
        return None
    inverse_depth = np.where(known, 1 / np.maximum(depth, 1e-3), 0).astype(np.float32)
    continued = np.asarray(cv2.inpaint(inverse_depth, (~known).astype(np.uint8), 5, cv2.INPAINT_NS))
    filled_depth = (1 / np.maximum(continued, 1e-3)).astype(np.float32)
    depths = _possible_depths(filled_depth, gap, view, views)
    placed = depths > 0
    if not placed.any():
        return None
    picture = (out.image.numpy() / np.maximum(alpha, 1e-3)).transpose(1, 2, 0).clip(0, 1)
    colors = fill_gap(picture, known, gap)
    full = np.zeros(gap.shape, np.float32)
    full[gap] = depths
    axes = T[:3, :3] * np.array([[1.0], [-1.0], [-1.0]])  # right, up, towards the camera
    return discs(view.view.points(full)[gap][placed], axes, depths[placed] / camera.fx, colors[placed])


def _possible_depths(depth: np.ndarray, gap: np.ndarray, view: HoleView, views: Sequence[HoleView]) -> np.ndarray:
    """Depths [M] of the gap's pixels, moved away from the camera where another view saw that there is nothing, in steps
    up to a third; 0 where that does not help."""
    out = np.zeros(int(gap.sum()), np.float32)
    for factor in ViewFillingTuning.depth_factors:
        todo = out == 0
        if todo.any():
            possible = could_be_hidden(view.view.points(factor * depth)[gap], views) & todo
            out[possible] = factor * depth[gap][possible]
    return out
