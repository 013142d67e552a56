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
_TILTS_DEG = np.arange(-12.0, 13.0, 2.0)
"""Of a sensor about its x and y axes, that are tried."""
_TILT_POINTS = 3000
_SLICE = 0.15
"""Metres that a tilted floor's points are off a plane at most."""
_BELOW = 0.01
"""Share of the points that may lie below a floor."""
_UPRIGHT_DEG = 4.0
"""A sensor that is tilted less stands upright: streets slope as much."""


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


def level_turn(points: np.ndarray) -> np.ndarray:
    """The turn R_level_sensor [3, 3] that makes the floor of a scan level, points [n, 3] about the sensor, z about up;
    the identity where the sensor stands upright, or there is no floor within its reach of 12 degrees."""
    near = points[np.hypot(points[:, 0], points[:, 1]) < _FLOOR_AROUND]
    near = near[np.isfinite(near).all(1)]
    few = near[:: max(1, len(near) // _TILT_POINTS)]
    if len(few) < _LEAST:
        return np.eye(3)
    ups = np.array([_up(*np.radians([x, y])) for x in _TILTS_DEG for y in _TILTS_DEG])
    ups = ups[np.argsort(-ups[:, 2], kind="stable")]  # of equals the least tilted
    counts, heights = zip(*(_fullest_below(few @ up) for up in ups), strict=True)
    best = int(np.argmax(counts))
    up, height = ups[best], heights[best]
    for _ in range(4):
        floor = near[np.abs(near @ up - height) < _SLICE]
        if len(floor) < _LEAST:
            return np.eye(3)
        up = np.linalg.svd(floor - floor.mean(0), full_matrices=False)[2][2]
        up = up if up[2] > 0 else -up
        height = float(np.median(floor @ up))
    tilt = np.degrees(np.arccos(np.clip(up[2], -1, 1)))
    return np.eye(3) if not _UPRIGHT_DEG < tilt < 1.5 * _TILTS_DEG[-1] else _turn_to_z(up)


def _up(x: float, y: float) -> np.ndarray:
    up = np.array([np.tan(x), np.tan(y), 1.0])
    return up / np.linalg.norm(up)


def _fullest_below(heights: np.ndarray) -> tuple[int, float]:
    """Points in the fullest slice below the sensor that has next to nothing below it, and its height."""
    slices = np.floor(-heights[heights < -_SLICE] / _SLICE).astype(np.int64)
    if not len(slices):
        return 0, 0.0
    counts = np.bincount(np.minimum(slices, 1000))
    below = len(slices) - np.cumsum(counts) - np.append(counts[1:], 0)
    counts[below > _BELOW * len(heights)] = 0
    fullest = int(counts.argmax())
    return int(counts[fullest]), -(fullest + 0.5) * _SLICE


def _turn_to_z(up: np.ndarray) -> np.ndarray:
    """The least turn that takes a unit vector, not -z, to z."""
    x, y, z = up
    k = 1 / (1 + z)
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])
