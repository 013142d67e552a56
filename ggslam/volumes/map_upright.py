# SPDX-License-Identifier: Apache-2.0
"""Which way is up in a map of Gaussians."""

from __future__ import annotations

import numpy as np

from ggslam.rendering.types import Gaussians
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.volumes.upright import Upright, estimate_up

_SAMPLED = 20_000
"""Gaussians that are looked at, about."""
_FLAT = 0.7
"""Logarithm of how many times thinner than wide a Gaussian must be to tell a normal."""


def upright_of(gaussians: Gaussians, poses: np.ndarray) -> Upright:
    """Up and floor from the surfaces of a map: flat Gaussians are thinnest along their normals.

    Args:
        gaussians: the map.
        poses: T_world_camera [N, 4, 4] of the frames.
    """
    step = max(1, len(gaussians.means) // _SAMPLED)
    points, normals = gaussians.means.numpy()[::step].astype(np.float64), _thinnest_axes(gaussians, step)
    # A Gaussian has no front; a camera saw it from the side where the cameras are.
    behind = (normals * (poses[:, :3, 3].mean(axis=0) - points)).sum(axis=1) < 0
    return estimate_up(poses, points, np.where(behind[:, None], -normals, normals))


def _thinnest_axes(gaussians: Gaussians, step: int) -> np.ndarray:
    """Direction [M, 3] in which every `step`-th Gaussian is thinnest; zero where it is nearly as thick as wide."""
    scales = gaussians.log_scales.numpy()[::step]
    thinnest, order = scales.argmin(axis=1), np.sort(scales, axis=1)
    rotations = quaternion_to_matrix(gaussians.quaternions.numpy()[::step])
    normals = np.take_along_axis(rotations, thinnest[:, None, None], axis=2)[:, :, 0]
    return np.where((order[:, 1] - order[:, 0] > _FLAT)[:, None], normals, 0.0)
