# SPDX-License-Identifier: Apache-2.0
"""Motions about the vertical: most objects stand and stay at their height."""

from __future__ import annotations

import numpy as np

from ggslam.scene.poses import rotation_about, transform_points
from ggslam.system.tuning import Tuning


class UprightTuning(Tuning):
    """When a motion keeps an object upright."""

    max_tilt_rad = np.radians(0.5)
    """Largest tilt, in radians."""


def upright(up: np.ndarray) -> np.ndarray:
    """Twists [6, 4] that keep a thing upright."""
    basis = np.zeros((6, 4))
    basis[:3, :3], basis[3:, 3] = np.eye(3), up
    return basis


def along_level(up: np.ndarray) -> np.ndarray:
    """Twists [6, 3] that keep a thing upright and at its height."""
    basis = np.zeros((6, 3))
    basis[:3, :2], basis[3:, 2] = np.linalg.svd(up[None])[2][1:].T, up
    return basis


def tilt(T: np.ndarray, up: np.ndarray) -> float:
    """Angle by which a motion tilts what stood upright, radians."""
    return float(np.arccos(np.clip(up @ T[:3, :3] @ up, -1, 1)))


def without_tilt(T: np.ndarray, up: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The motion [4, 4] that does the same to a point and turns about the vertical alone."""
    tilted = T[:3, :3] @ up
    axis = np.cross(tilted, up)
    length = float(np.linalg.norm(axis))
    R = T[:3, :3]
    if length > 1e-9:
        R = rotation_about(axis / length, float(np.degrees(tilt(T, up)))) @ R
    level = np.eye(4)
    level[:3, :3] = R
    level[:3, 3] = transform_points(point[None], T)[0] - R @ point
    return level


def turned_about(axis: np.ndarray, degrees: float, point: np.ndarray) -> np.ndarray:
    """The motion [4, 4] that turns about an axis [3], a unit vector, through a point [3]."""
    T = np.eye(4)
    T[:3, :3] = rotation_about(axis, degrees)
    T[:3, 3] = point - T[:3, :3] @ point
    return T
