# SPDX-License-Identifier: Apache-2.0
"""Adapts a map to be drawn larger than it was trained.

A renderer widens every projected Gaussian by `LOW_PASS`, a variance in its own pixels. Drawn at twice the size that
is a quarter of what the map was trained with: splats come out thin, with seams between them. Mip-Splatting (Yu et al.,
CVPR 2024) limits the frequencies of a Gaussian by the closest view that saw it; here what is missing of the low-pass is
put into the Gaussians themselves, by the same closest view, so that any renderer draws them as trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ggslam.errors import ConfigError
from ggslam.rendering.types import LOW_PASS
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import inverse
from ggslam.system.tuning import Tuning


class ZoomTuning(Tuning):
    """Views that a map was trained from."""

    max_views = 300
    """Most views that are tested, spread evenly: the closest of them is nearly the closest of all."""
    near_m = 0.05
    """Smallest depth in metres."""


@dataclass(frozen=True)
class ZoomWidening:
    """Widens Gaussians for a renderer whose pixels are `zoom` times smaller than those of the training views.

    Attributes:
        camera: of the training views.
        T_world_camera: their poses, each [4, 4].
        zoom: at least 1.
        cameras: of each view, if not all are `camera`'s.

    Raises:
        ConfigError: no views, or an impossible zoom.
    """

    camera: Camera
    T_world_camera: Sequence[np.ndarray]
    zoom: float
    cameras: Sequence[Camera] | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.zoom <= 1000:
            raise ConfigError(f"`zoom`: expected 1 to 1000, found {self.zoom:g}")
        if not len(self.T_world_camera):
            raise ConfigError("`zoom`: the map has no keyframes, so the size that it was trained at is not known")

    @property
    def variance(self) -> float:
        """What is added to the variances of a Gaussian, in pixels^2 of its closest view."""
        return LOW_PASS * (1 - 1 / self.zoom**2)

    def __call__(self, gaussians: GaussianMap) -> None:
        """Changes the scales of `gaussians` in place."""
        if len(gaussians):
            pixel = self.closest_depths(gaussians.means.numpy()) / np.sqrt(self.camera.fx * self.camera.fy)
            added = torch.from_numpy(self.variance * pixel**2).to(gaussians.log_scales.dtype)
            gaussians.log_scales[:] = 0.5 * torch.log(torch.exp(2 * gaussians.log_scales) + added[:, None])

    def closest_depths(self, points: np.ndarray) -> np.ndarray:
        """Smallest depth, float64 [N], in metres, at which a view has each of the points [N, 3] in its image; of
        points in no image, their distance from the nearest camera. Depth in views of another camera is as if `camera`
        had pixels as large there."""
        chosen = np.unique(np.linspace(0, len(self.T_world_camera) - 1, ZoomTuning.max_views).round().astype(int))
        depth, distance = np.full(len(points), np.inf), np.full(len(points), np.inf)
        focal = np.sqrt(self.camera.fx * self.camera.fy)
        for T, c in ((self.T_world_camera[i], self.cameras[i] if self.cameras else self.camera) for i in chosen):
            larger = 1.0 if c == self.camera else focal / np.sqrt(c.fx * c.fy)
            R, t = inverse(T)[:3, :3], inverse(T)[:3, 3]
            seen = points @ R.T + t
            z = np.maximum(seen[:, 2], ZoomTuning.near_m)
            u, v = c.fx * seen[:, 0] / z + c.cx, c.fy * seen[:, 1] / z + c.cy
            inside = (
                (seen[:, 2] > ZoomTuning.near_m) & (u > -0.5) & (v > -0.5) & (u < c.width - 0.5) & (v < c.height - 0.5)
            )
            depth[inside] = np.minimum(depth[inside], larger * z[inside])
            distance = np.minimum(distance, larger * np.linalg.norm(seen, axis=1))
        return np.where(np.isfinite(depth), depth, np.maximum(distance, ZoomTuning.near_m))
