# SPDX-License-Identifier: Apache-2.0
"""Growth of the map as in 3D Gaussian Splatting (Kerbl et al., 2023): where images pull at Gaussians there are too few.

A small Gaussian is cloned, a large one split into two. Otherwise than there the gradients are not summed up from step
to step but taken of a few keyframes when they are needed, so that nothing has to be remembered; opacities are not
reset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from ggslam.geometry.image_parts import coarse_grid
from ggslam.mapping.keyframe import Keyframe
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.poses import quaternion_to_matrix, transform_points
from ggslam.system.tuning import Tuning


class DensificationTuning(Tuning):
    """Which Gaussians become more."""

    views = 8
    """Newest keyframes whose gradients count."""
    least_gradient = 2e-4
    """Mean norm of the loss's gradient by a Gaussian's place in the image, whose half width and half height are 1, from
    which it becomes more: the value of 3DGS."""
    large_share = 0.01
    """Standard deviation from which a Gaussian is split and not cloned, as a share of its distance."""
    shrink = 1.6
    """Factor by which the parts of a split are smaller: the value of 3DGS."""
    sparse_stride = 4
    """Distance, in rows and columns, of the pixels at which Gaussians are inserted if densification does the rest."""


@dataclass
class ScreenGradients:
    """Norms of the gradients by places in the image, over views.

    Attributes:
        total: float64 [N], their sums.
        views: int64 [N], views that show each Gaussian.
        nearest: float64 [N], metres, least depth in a view that shows it; infinite without one.
    """

    total: np.ndarray
    views: np.ndarray
    nearest: np.ndarray

    @staticmethod
    def none(count: int) -> ScreenGradients:
        """Of `count` Gaussians in no view."""
        return ScreenGradients(np.zeros(count), np.zeros(count, np.int64), np.full(count, np.inf))

    def add(self, keyframe: Keyframe, means: np.ndarray, gradient: np.ndarray, shown: np.ndarray) -> None:
        """A keyframe's view counts.

        Args:
            keyframe: with its pose and camera.
            means: [N, 3], world.
            gradient: of the loss by the means, [N, 3].
            shown: bool [N].
        """
        camera, pose = keyframe.camera, keyframe.T_camera_world
        z = transform_points(means, pose)[:, 2]
        sideways = gradient @ pose[:3, :3].T  # a shift by x metres moves the image by x f / z pixels
        size = np.array([camera.width / camera.fx, camera.height / camera.fy]) / 2
        norm = np.linalg.norm(sideways[:, :2] * size, axis=1) * z
        self.total += np.where(shown, norm, 0)
        self.views += shown
        self.nearest = np.where(shown, np.minimum(self.nearest, z), self.nearest)

    @property
    def mean(self) -> np.ndarray:
        """Of the views that show each, [N]; 0 without one."""
        return self.total / np.maximum(self.views, 1)


def densify(gaussians: GaussianMap, gradients: ScreenGradients, seed: int) -> tuple[int, int]:
    """Clones and splits what images pull at; returns how many of each.

    Args:
        gaussians: the map, on the CPU; new rows come last, and those that were split go.
        gradients: of its Gaussians.
        seed: of the places of parts.
    """
    chosen = gradients.mean > DensificationTuning.least_gradient
    largest = gaussians.log_scales.numpy().max(1)
    large = largest > np.log(DensificationTuning.large_share * gradients.nearest)
    cloned, split = (torch.from_numpy(np.flatnonzero(rows)) for rows in (chosen & ~large, chosen & large))
    new = [_unborn(gaussians.take(cloned))]
    random = np.random.default_rng([seed, 23])
    for _ in range(2):
        part = _unborn(gaussians.take(split))
        turn = quaternion_to_matrix(part["quaternions"].double().numpy())
        sigma = np.exp(part["log_scales"].double().numpy())
        away = np.einsum("nij,nj->ni", turn, sigma * random.standard_normal(sigma.shape))
        part["means"] += torch.from_numpy(away).to(part["means"])
        part["log_scales"] -= math.log(DensificationTuning.shrink)
        new.append(part)
    stays = torch.ones(len(gaussians), dtype=torch.bool)
    stays[split] = False
    gaussians.keep(stays)
    for rows in new:
        gaussians.append(rows)
    return len(cloned), len(split)


def _unborn(rows: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Copies of Gaussians that no optimizer has stepped yet."""
    for name, array in rows.items():
        if "." in name or name.endswith("updates"):
            array.zero_()
    return rows


def sparse_pixels(where: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    """bool [H, W]: of the pixels to insert at (None: all) those on a coarse grid."""
    grid = coarse_grid(shape, DensificationTuning.sparse_stride)
    return grid if where is None else grid & where
