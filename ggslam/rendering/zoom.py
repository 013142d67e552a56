# SPDX-License-Identifier: Apache-2.0
"""Adapts a map to be drawn larger or smaller than it was trained.

A renderer widens every projected Gaussian by `LOW_PASS`, a variance in its own pixels. Drawn at twice the size that
is a quarter of what the map was trained with: splats come out thin, with seams between them. At half the size it is
four times as much: splats cover what is beside them. Mip-Splatting (Yu et al., CVPR 2024) limits the frequencies of a
Gaussian by the closest view that saw it, and keeps what it adds up to in the image; here what is missing of the
low-pass is put into the Gaussians themselves, by the same closest view, and what is too much is taken out of their
sizes or, where they are too small, their opacities, so that any renderer draws them as trained.
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
    least_variance = 1e-3
    """Gaussians are not made narrower than this, pixels^2."""
    least_opacity = 1e-4
    """Nor more transparent than this."""


@dataclass(frozen=True)
class ZoomFit:
    """Fits Gaussians to a renderer whose pixels are `zoom` times smaller than those of the training views.

    Attributes:
        camera: of the training views.
        T_world_camera: their poses, each [4, 4].
        zoom: 0.05 to 1000.
        cameras: of each view, if not all are `camera`'s.

    Raises:
        ConfigError: no views, or an impossible zoom.
    """

    camera: Camera
    T_world_camera: Sequence[np.ndarray]
    zoom: float
    cameras: Sequence[Camera] | None = None

    def __post_init__(self) -> None:
        if not 0.05 <= self.zoom <= 1000:
            raise ConfigError(f"`zoom`: expected 0.05 to 1000, found {self.zoom:g}")
        if not len(self.T_world_camera):
            raise ConfigError("`zoom`: the map has no keyframes, so the size that it was trained at is not known")

    @property
    def variance(self) -> float:
        """What a Gaussian lacks of the low-pass, in pixels^2 of a training view; negative: what it has too much."""
        return LOW_PASS * (1 - 1 / self.zoom**2)

    def __call__(self, gaussians: GaussianMap) -> None:
        """Changes scales and opacities of `gaussians` in place."""
        if not len(gaussians) or self.zoom == 1:
            return
        closest, usual = self.depths(gaussians.means.numpy())
        # What is too wide from nearby has no seams; what is too bold is so in most views.
        depth = closest if self.zoom > 1 else usual
        pixel = torch.from_numpy(depth / np.sqrt(self.camera.fx * self.camera.fy)).to(gaussians.log_scales.dtype)
        variance = torch.exp(2 * gaussians.log_scales) / pixel[:, None] ** 2
        if self.zoom > 1:
            fitted = variance + self.variance
        else:
            fitted = torch.minimum(variance, (variance + self.variance).clamp_min(ZoomTuning.least_variance))
            self._dim(gaussians, variance, fitted)
        gaussians.log_scales[:] = 0.5 * torch.log(fitted) + torch.log(pixel)[:, None]

    def _dim(self, gaussians: GaussianMap, before: torch.Tensor, fitted: torch.Tensor) -> None:
        """Makes Gaussians more transparent by what they cover more of the image than before; `before` and `fitted`:
        variances [N, 3] of their axes, of which the two longest are what is seen."""
        share = (before + LOW_PASS) / (fitted + LOW_PASS / self.zoom**2)
        seen = before.topk(2, dim=1).indices
        covered = torch.gather(share, 1, seen).prod(1).sqrt().clamp_max(1).view_as(gaussians.opacity_logits)
        least = ZoomTuning.least_opacity
        gaussians.opacity_logits[:] = torch.logit(
            (torch.sigmoid(gaussians.opacity_logits) * covered).clamp(least, 1 - least)
        )

    def depths(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The smallest depth, float64 [N], in metres, at which a view has each of the points [N, 3] in its image, and
        the geometric mean of all; of points in no image, both are their distance from the nearest camera. Depth in
        views of another camera is as if `camera` had pixels as large there."""
        chosen = np.unique(np.linspace(0, len(self.T_world_camera) - 1, ZoomTuning.max_views).round().astype(int))
        depth, distance = np.full(len(points), np.inf), np.full(len(points), np.inf)
        logs, count = np.zeros(len(points)), np.zeros(len(points))
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
            logs[inside] += np.log(larger * z[inside])
            count += inside
            distance = np.minimum(distance, larger * np.linalg.norm(seen, axis=1))
        closest = np.where(count > 0, depth, np.maximum(distance, ZoomTuning.near_m))
        return closest, np.where(count > 0, np.exp(logs / np.maximum(count, 1)), closest)
