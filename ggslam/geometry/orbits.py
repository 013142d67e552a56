# SPDX-License-Identifier: Apache-2.0
"""Camera paths around a cloud that has no recorded views."""

from __future__ import annotations

import math

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class OrbitTuning(Tuning):
    """Views around a cloud."""

    framed_share = 0.95
    """Share of the points that are framed."""
    background = 2.5
    """Distance from the centre, in median distances, beyond which points count as background."""
    elevation_rad = math.radians(20.0)
    """Elevation of the cameras in radians."""


def orbit(points: np.ndarray, camera: Camera, count: int) -> np.ndarray:
    """Poses on a circle around most of the points, a little above, looking at their middle.

    Args:
        points: float [N, 3], metres, at least one; y is down.
        camera: that frames them.
        count: of poses, the same angle apart; the first looks along z.

    Returns:
        T_world_camera float64 [count, 4, 4].
    """
    middle = np.median(points, axis=0).astype(np.float64)
    distances = np.linalg.norm(points - middle, axis=1)
    radius = min(
        float(np.quantile(distances, OrbitTuning.framed_share)), OrbitTuning.background * float(np.median(distances))
    )
    half = min(math.atan(camera.width / (2 * camera.fx)), math.atan(camera.height / (2 * camera.fy)))
    away = max(radius, 1e-3) / math.sin(half)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle in zip(poses, 2 * np.pi * np.arange(count) / count, strict=True):
        forward = np.array([math.sin(angle) * math.cos(OrbitTuning.elevation_rad), math.sin(OrbitTuning.elevation_rad),
                            math.cos(angle) * math.cos(OrbitTuning.elevation_rad)])  # fmt: skip
        right = np.array([math.cos(angle), 0.0, -math.sin(angle)])
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
        pose[:3, 3] = middle - away * forward
    return poses
