# SPDX-License-Identifier: Apache-2.0
"""What one map shows where another one's keyframes look: what is double, and which keyframes are at the seam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ggslam.merging.settings import DoubleSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse, transform_points

_SEAM_WIDTH = 160
"""Pixels of the small pictures that seams are looked for in."""


@dataclass(frozen=True)
class PlacedRun:
    """A run's map in the common world, and where its keyframes look from.

    Attributes:
        gaussians: its map; `birth_keyframe` counts its own keyframes.
        cameras: of its keyframes' images.
        T_world_camera: of its keyframes, float64 [K, 4, 4].
    """

    gaussians: GaussianMap
    cameras: list[Camera]
    T_world_camera: np.ndarray


class Coverage:
    """Renders maps from keyframes.

    Args:
        settings: when two maps show the same surface.
        context: threads.
    """

    def __init__(self, settings: DoubleSettings, context: NativeContext) -> None:
        self._settings = settings
        self._rasterizer = CpuRasterizer(context=context)

    def doubles(self, base: GaussianMap, run: PlacedRun) -> np.ndarray:
        """Which of a run's Gaussians the map `base` makes needless, bool [N]: where the keyframe that inserted them
        looks, it shows the same surface. A run that had begun with `base` would not have inserted them."""
        double = np.zeros(len(run.gaussians), bool)
        birth, means = run.gaussians.birth_keyframe.numpy(), run.gaussians.means.numpy()
        for number, (T, camera) in enumerate(zip(run.T_world_camera, run.cameras, strict=True)):
            rows = np.flatnonzero(birth == number)
            if len(rows) and len(base):
                alpha, depth = self._show(base, camera, T)
                points = transform_points(means[rows].astype(float), inverse(T))
                double[rows] = self._is_shown(points, camera, alpha, depth)
        return double

    def shared_views(self, base: GaussianMap, run: PlacedRun) -> np.ndarray:
        """Share of each keyframe's view in which the run's map and another one show the same surface, [K]."""
        shares = []
        for T, whole in zip(run.T_world_camera, run.cameras, strict=True):
            camera = whole.resize(_SEAM_WIDTH, max(1, round(whole.height * _SEAM_WIDTH / whole.width)))
            own_alpha, own_depth = self._show(run.gaussians, camera, T)
            alpha, depth = self._show(base, camera, T)
            opaque = (alpha >= self._settings.alpha) & (own_alpha >= self._settings.alpha)
            shares.append(float((opaque & (np.abs(depth - own_depth) <= self._tolerance(depth))).mean()))
        return np.array(shares)

    def _show(
        self, gaussians: GaussianMap, camera: Camera, T_world_camera: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Alpha and depth [H, W]."""
        view = self._rasterizer.forward(gaussians, camera, inverse(T_world_camera), features=False)
        return view.alpha.numpy().copy(), view.expected_depth.numpy().copy()

    def _is_shown(self, points: np.ndarray, camera: Camera, alpha: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Which points [n, 3] of the camera's frame lie on what is rendered, bool [n]."""
        z = np.maximum(points[:, 2], 1e-6)
        column = np.rint(camera.fx * points[:, 0] / z + camera.cx).astype(np.int64)
        row = np.rint(camera.fy * points[:, 1] / z + camera.cy).astype(np.int64)
        inside = (points[:, 2] > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        pixels = np.where(inside, row * camera.width + column, 0)
        there = depth.reshape(-1)[pixels]
        near = np.abs(there - points[:, 2]) <= self._tolerance(there)
        return inside & near & (alpha.reshape(-1)[pixels] >= self._settings.alpha)

    def _tolerance(self, depth: np.ndarray) -> np.ndarray:
        s = self._settings
        return np.maximum(s.tolerance_m, s.tolerance_relative * depth)


def without_rows(gaussians: GaussianMap, dropped: np.ndarray) -> int:
    """Takes Gaussians (bool [N]) out of a map; returns how many that were."""
    return gaussians.keep(torch.from_numpy(~dropped))
