# SPDX-License-Identifier: Apache-2.0
"""Points of a laser scan as G-ICP wants them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.errors import check_ranges
from ggslam.tracking.points import FramePoints

_THICKNESS = 0.01
"""Variance of a point in every direction, in the unit of `TargetSettings.min_thickness`: a match with a plane then
counts the distance to the plane."""


@dataclass(frozen=True)
class ScanSettings:
    """How points are taken from a scan."""

    voxel: float = 0.2
    """Of the points in a cube with this edge one is used, in metres; near surfaces then count no more than far ones."""
    nearest: float = 0.3
    farthest: float = 60.0
    """Range in metres."""

    def __post_init__(self) -> None:
        check_ranges(self, {"voxel": (1e-3, 100), "nearest": (0, 1e4), "farthest": (1e-3, 1e6)})


def scan_points(points: np.ndarray, settings: ScanSettings) -> FramePoints:
    """Points of a scan, in the sensor's frame, evenly spread.

    A scan with few rings has no neighbours to fit a plane to, so the points have no shape of their own, and in place
    of a normal the direction to the sensor: what the sensor sees faces it, which tells the two sides of a wall apart
    (align with `min_normal_dot` 0).

    Args:
        points: [n, 3], metres, in the sensor's frame, in any order; those that are not finite are left out.
    """
    points = np.ascontiguousarray(points, np.float32)
    distance = np.linalg.norm(points, axis=1)
    within = np.nonzero((distance >= settings.nearest) & (distance <= settings.farthest))[0]  # NaN is not
    cells = np.floor(points[within] / settings.voxel).astype(np.int64)
    span = int(2 * settings.farthest / settings.voxel) + 3
    _, first = np.unique((cells[:, 0] * span + cells[:, 1]) * span + cells[:, 2], return_index=True)
    chosen = within[np.sort(first)]
    count = len(chosen)
    shape = np.tile(np.array([1, 0, 0, 1, 0, 1], np.float32) * np.float32(_THICKNESS), (count, 1))
    return FramePoints(
        points[chosen], -points[chosen] / distance[chosen, None], shape, np.zeros((count, 2), np.int32),
        np.ones(count, np.float32),
    )  # fmt: skip
