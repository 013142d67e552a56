# SPDX-License-Identifier: Apache-2.0
"""Which keyframes are at a seam: what their own map shows there another run's map shows, too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.merging.settings import SeamSettings
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.sight.margin import Margin
from ggslam.sight.view import Sight, View
from ggslam.system.tuning import Tuning


class SeamViewTuning(Tuning):
    """How seams are looked for."""

    width = 160
    """Width of the small pictures, in pixels."""


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

    def __init__(self, settings: SeamSettings, context: NativeContext) -> None:
        self._alpha, self._margin = settings.alpha, Margin(settings.tolerance_m, settings.tolerance_relative)
        self._context = context
        self._rasterizer = CpuRasterizer(context=context)

    def shared_views(self, base: GaussianMap, run: PlacedRun) -> np.ndarray:
        """Share of each keyframe's view in which the run's map and another one show the same surface, [K]."""
        shares = []
        for T, whole in zip(run.T_world_camera, run.cameras, strict=True):
            camera = whole.resize(
                SeamViewTuning.width, max(1, round(whole.height * SeamViewTuning.width / whole.width))
            )
            view = View.of(self._show(base, camera, T), camera, T, self._margin, self._context)
            shares.append(float((view.classify_depth(self._show(run.gaussians, camera, T)) == Sight.SAME).mean()))
        return np.array(shares)

    def _show(self, gaussians: GaussianMap, camera: Camera, T_world_camera: np.ndarray) -> np.ndarray:
        """Depth [H, W] where a map is opaque, else 0."""
        view = self._rasterizer.forward(gaussians, camera, inverse(T_world_camera), features=False)
        return np.where(view.alpha.numpy() >= self._alpha, view.expected_depth.numpy(), np.float32(0))
