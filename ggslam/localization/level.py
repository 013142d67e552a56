# SPDX-License-Identifier: Apache-2.0
"""Levelled sensor frames: z points up, and the floor is somewhere below the sensor."""

from __future__ import annotations

import numpy as np

from ggslam.submaps.settings import GridAxes
from ggslam.system.tuning import Tuning


class LevelTuning(Tuning):
    """Search for the floor and the vertical axis."""

    low_m = 0.3
    """Lower end of the heights above the floor, in metres, at which a place is recognised: above the ground..."""
    high_m = 2.2
    """...and their upper end, below ceilings."""
    slice_m = 0.1
    """Height, in metres, of the slices in which the floor is searched."""
    around_m = 15.0
    """Distance from the sensor, in metres, up to which points count."""
    min_share = 0.25
    """Fewest points of the floor's slice, as a share of the fullest one's. The lowest such slice is the floor."""
    min_points = 50
    """Fewest points that define a floor."""
    tilt_points = 3000
    """Most points on which tilts are compared."""
    tilted_slice_m = 0.15
    """Largest distance, in metres, of points from the plane of a tilted floor."""
    max_below = 0.01
    """Largest share of the points below a floor."""
    upright_deg = 4.0
    """Largest tilt, in degrees, of an upright sensor: streets slope as much."""
    tilts_deg = np.arange(-12.0, 13.0, 2.0)
    """Tilts of a sensor about its x and y axes, in degrees, that are tried."""




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
    near = points[np.hypot(points[:, 0], points[:, 1]) < LevelTuning.around_m, 2]
    near = near[np.isfinite(near)]
    if len(near) < LevelTuning.min_points:
        return None
    low = float(near.min())
    counts = np.bincount(np.minimum((near - low) / LevelTuning.slice_m, 1000).astype(np.int64))
    counts = counts + np.append(counts[1:], 0)  # a floor lies in one slice or two
    lowest = int(np.argmax(counts >= LevelTuning.min_share * counts.max()))
    inside = (near >= low + lowest * LevelTuning.slice_m) & (near < low + (lowest + 2) * LevelTuning.slice_m)
    return float(np.median(near[inside]))


def between(points: np.ndarray, floor: float) -> np.ndarray:
    """Which level points [n, 3] stand between knee and head height, bool [n]."""
    return (points[:, 2] > floor + LevelTuning.low_m) & (points[:, 2] < floor + LevelTuning.high_m)


def level_turn(points: np.ndarray) -> np.ndarray:
    """The turn R_level_sensor [3, 3] that makes the floor of a scan level, points [n, 3] about the sensor, z about up;
    the identity where the sensor stands upright, or there is no floor within its reach of 12 degrees."""
    near = points[np.hypot(points[:, 0], points[:, 1]) < LevelTuning.around_m]
    near = near[np.isfinite(near).all(1)]
    few = near[:: max(1, len(near) // LevelTuning.tilt_points)]
    if len(few) < LevelTuning.min_points:
        return np.eye(3)
    ups = np.array([_up(*np.radians([x, y])) for x in LevelTuning.tilts_deg for y in LevelTuning.tilts_deg])
    ups = ups[np.argsort(-ups[:, 2], kind="stable")]  # of equals the least tilted
    counts, heights = zip(*(_fullest_below(few @ up) for up in ups), strict=True)
    best = int(np.argmax(counts))
    up, height = ups[best], heights[best]
    for _ in range(4):
        floor = near[np.abs(near @ up - height) < LevelTuning.tilted_slice_m]
        if len(floor) < LevelTuning.min_points:
            return np.eye(3)
        up = np.linalg.svd(floor - floor.mean(0), full_matrices=False)[2][2]
        up = up if up[2] > 0 else -up
        height = float(np.median(floor @ up))
    tilt = np.degrees(np.arccos(np.clip(up[2], -1, 1)))
    return np.eye(3) if not LevelTuning.upright_deg < tilt < 1.5 * LevelTuning.tilts_deg[-1] else _turn_to_z(up)


def _up(x: float, y: float) -> np.ndarray:
    up = np.array([np.tan(x), np.tan(y), 1.0])
    return up / np.linalg.norm(up)


def _fullest_below(heights: np.ndarray) -> tuple[int, float]:
    """Points in the fullest slice below the sensor that has next to nothing below it, and its height."""
    slices = np.floor(-heights[heights < -LevelTuning.tilted_slice_m] / LevelTuning.tilted_slice_m).astype(np.int64)
    if not len(slices):
        return 0, 0.0
    counts = np.bincount(np.minimum(slices, 1000))
    below = len(slices) - np.cumsum(counts) - np.append(counts[1:], 0)
    counts[below > LevelTuning.max_below * len(heights)] = 0
    fullest = int(counts.argmax())
    return int(counts[fullest]), -(fullest + 0.5) * LevelTuning.tilted_slice_m


def _turn_to_z(up: np.ndarray) -> np.ndarray:
    """The least turn that takes a unit vector, not -z, to z."""
    x, y, z = up
    k = 1 / (1 + z)
    return np.array([[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]])
