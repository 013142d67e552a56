# SPDX-License-Identifier: Apache-2.0
"""Thins clouds to one point per voxel, so that surfaces count by area whatever their distance from the sensor. Voxels
start at the cloud's lowest corner: a cloud far from zero is thinned like one near it."""

from __future__ import annotations

import numpy as np


def thinned_points(points: np.ndarray, voxel: float) -> np.ndarray:
    """The mean [m, 3] of the points [n, 3] of each voxel."""
    corner = points.min(0)
    _, which, counts = np.unique(_numbers(points - corner, voxel), return_inverse=True, return_counts=True)
    sums = [np.bincount(which.reshape(-1), points[:, axis] - corner[axis]) for axis in range(3)]
    return np.stack(sums, 1) / counts[:, None] + corner


def thinned_rows(points: np.ndarray, voxel: float) -> np.ndarray:
    """The first point of each voxel, rows [m] of points [n, 3]."""
    return np.sort(np.unique(_numbers(points - points.min(0), voxel), return_index=True)[1])


def _numbers(offsets: np.ndarray, voxel: float) -> np.ndarray:
    """A number for the voxel of each offset [n, 3] from the lowest corner."""
    cells = np.floor(offsets / voxel)
    size = cells.max(0) + 1
    if not size.prod() < 2.0**53:  # no longer whole in double precision
        return np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    return (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
