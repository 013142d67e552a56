# SPDX-License-Identifier: Apache-2.0
"""Level frames: z points up, the floor is somewhere below the sensor."""

from __future__ import annotations

import numpy as np

from ggslam.submaps.settings import GridAxes

LOW, HIGH = 0.3, 2.2
"""Metres above the floor between which things tell where one is: not ground, not ceilings."""
_FLOOR_STEP, _FLOOR_AROUND, _FLOOR_SHARE = 0.1, 15.0, 0.25
"""The floor is the lowest slice of this height, of the points so near, with this share of the fullest one's."""
_LEAST = 50
"""Points that tell where the floor is at least."""


def level_axes(axes: GridAxes) -> np.ndarray:
    """R_world_level [3, 3]: the axes of a level frame in the world of a grid. Of a grid "xz" y points down, of others z
    is taken to point up."""
    return np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]) if axes == "xz" else np.eye(3)


def about_z(angle: float) -> np.ndarray:
    """The turn by an angle in radians about z, [3, 3]."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def floor_height(points: np.ndarray) -> float | None:
    """Height of the floor around the origin in level points [n, 3], metres; None where they do not tell."""
    near = points[np.hypot(points[:, 0], points[:, 1]) < _FLOOR_AROUND, 2]
    near = near[np.isfinite(near)]
    if len(near) < _LEAST:
        return None
    low = float(near.min())
    counts = np.bincount(np.minimum((near - low) / _FLOOR_STEP, 1000).astype(np.int64))
    counts = counts + np.append(counts[1:], 0)  # a floor lies in one slice or two
    lowest = int(np.argmax(counts >= _FLOOR_SHARE * counts.max()))
    inside = (near >= low + lowest * _FLOOR_STEP) & (near < low + (lowest + 2) * _FLOOR_STEP)
    return float(np.median(near[inside]))


def between(points: np.ndarray, floor: float) -> np.ndarray:
    """Which level points [n, 3] stand between knee and head height, bool [n]."""
    return (points[:, 2] > floor + LOW) & (points[:, 2] < floor + HIGH)
