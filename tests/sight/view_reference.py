# SPDX-License-Identifier: Apache-2.0
"""What `View.classify_points` says, slowly, one place after the other."""

from __future__ import annotations

import math

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.sight.margin import Margin
from ggslam.sight.view import Sight


def classify(
    points: np.ndarray, depth: np.ndarray, camera: Camera, T_world_camera: np.ndarray, margin: Margin
) -> np.ndarray:
    """A `Sight` for each world point [n, 3], uint8 [n]."""
    T_camera_world = np.linalg.inv(T_world_camera)
    return np.array([_judge((T_camera_world @ [*p, 1.0])[:3], depth, camera, margin) for p in points], np.uint8)


def _judge(point: np.ndarray, depth: np.ndarray, camera: Camera, margin: Margin) -> Sight:
    x, y, z = point
    if not (math.isfinite(x) and math.isfinite(y) and z > 0):
        return Sight.OUTSIDE
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    if not (abs(u) < 1e9 and abs(v) < 1e9):
        return Sight.OUTSIDE
    column, row = round(u), round(v)
    if not (0 <= column < camera.width and 0 <= row < camera.height):
        return Sight.OUTSIDE
    own = float(depth[row, column])
    if own <= 0:
        return Sight.UNKNOWN
    within = max(margin.least, margin.share * z) + margin.sigmas * (margin.constant + margin.square * z * z)
    if abs(own - z) <= within:
        return Sight.SAME
    about = depth[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2].astype(float)
    whole = bool((about > 0).all())
    if own > z:
        return Sight.THROUGH if whole and about.min() > z + within else Sight.BEFORE
    return Sight.HIDDEN if whole and about.max() < z - within else Sight.BEHIND
