# SPDX-License-Identifier: Apache-2.0
"""Converts laser scans into points for G-ICP."""

from __future__ import annotations

import numpy as np

from ggslam.system.settings import Conflict, setting, settings_class
from ggslam.system.tuning import Tuning
from ggslam.tracking.points import FramePoints


class ScanPointTuning(Tuning):
    """Shape of a scan's points."""

    thickness = 0.01
    """Variance of a point in every direction, in the unit of `TargetSettings.min_thickness`. A match with a plane then
    measures the distance to the plane."""


@settings_class(frozen=True)
class ScanSettings:
    """How points are sampled from a scan."""

    voxel: float = setting(0.2, 1e-3, 100, "m")
    """One point is used per cube of this edge, so that near surfaces count no more than far ones."""
    nearest: float = setting(0.3, 0, 1e4, "m")
    """Nearer points are ignored."""
    farthest: float = setting(60.0, 1e-3, 1e6, "m")
    """Farther points are ignored."""

    def __post_init__(self) -> None:
        if self.nearest >= self.farthest:
            raise Conflict("farthest", f"expected more than nearest, {self.nearest:g}, found {self.farthest:g}")


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
    shape = np.tile(np.array([1, 0, 0, 1, 0, 1], np.float32) * np.float32(ScanPointTuning.thickness), (count, 1))
    return FramePoints(
        points[chosen], -points[chosen] / distance[chosen, None], shape, np.zeros((count, 2), np.int32),
        np.ones(count, np.float32),
    )  # fmt: skip
