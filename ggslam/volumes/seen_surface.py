# SPDX-License-Identifier: Apache-2.0
"""What was seen of surfaces, as it lies above a plane: the points that distances are measured from, and the measured
points beside them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from ggslam.system.tuning import Tuning
from ggslam.volumes.cell_grid import CellGrid, GridWindow, SlicePlane
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.measured_points import measured_octants


class SeenSurfaceTuning(Tuning):
    """What counts as a floor's own points."""

    floor_reach = 1.25
    """Height of the middle of an eighth of a voxel above a floor up to which the floor may lie in it, in halves of its
    height; more than 1 by what floors are found off."""


_BESIDE = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


class _Layered:
    """Points [n, 3] and their heights above a plane, float32 [n]; those between two heights are placed on the plane."""

    def __init__(self, points: np.ndarray, plane: SlicePlane) -> None:
        self._points, self._plane = points, plane
        normal = plane.normal.astype(points.dtype)
        # Not as a product of matrices, whose roundings depend on where a point stands among the others.
        along = points[:, 0] * normal[0] + points[:, 1] * normal[1] + points[:, 2] * normal[2]
        self._heights = (along - np.float32(plane.origin @ plane.normal)).astype(np.float32)

    def between(self, low: float, high: float, which: np.ndarray | None = None) -> np.ndarray:
        """x and y on the plane, float64 [m, 2], metres; `which` bool [n]: of these only."""
        chosen = (self._heights >= low) & (self._heights <= high)
        return self._plane.coordinates(self._points[chosen if which is None else chosen & which].astype(float))[:, :2]


class SeenSurface:
    """Surfaces above a plane: surface points of a distance field, and eighths of voxels that points were measured in.

    Args:
        field: which, with its TSDF, has them.
        plane: its normal is up.
        owns: tells of points [N, 3] from the field's origin, metres, which count; None: all do.
    """

    def __init__(
        self, field: DistanceField, plane: SlicePlane, owns: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> None:
        points, normals = field.surface()
        # Seen from the field's origin, so that a map far from zero gives the same bits.
        sites, octants = (points - field.origin).astype(np.float32), measured_octants(field.tsdf)
        if owns is not None:
            own = owns(sites)
            sites, normals, octants = sites[own], normals[own], octants[owns(octants)]
        plane = replace(plane, origin=plane.origin - field.origin)
        lone = (normals[:, 0] == 0) & (normals[:, 1] == 0) & (normals[:, 2] == 0)
        self._sites, self._octants = _Layered(sites, plane), _Layered(octants, plane)
        self._thin = _thin_octants(octants, sites[lone].astype(float), field.voxel)
        self._reach = field.voxel / 4 * np.abs(np.stack([plane.x_axis, plane.y_axis, plane.normal])).sum(1)
        """How far an eighth reaches from its middle along the plane's axes."""

    def sites(self, low: float, high: float) -> np.ndarray:
        """The surface points between two heights: x and y, float64 [n, 2], metres."""
        return self._sites.between(low, high)

    def near_points(
        self, grid: CellGrid, low: float, high: float, on_floor: bool = False, window: GridWindow | None = None
    ) -> np.ndarray:
        """Cells, bool [H, W], of a grid or its window, that may have a measured point in them between two heights: none
        of them is free.

        `on_floor`: the plane is a floor. Eighths of voxels that it lies in are full of its own points; of coarse voxels
        they reach up to the lower height and would leave no cell free."""
        reach = self._reach[2]
        lowest = max(low - reach, min(SeenSurfaceTuning.floor_reach * reach, low)) if on_floor else low - reach
        return grid.mark(self._octants.between(lowest, high + reach), self._reach[:2], window)

    def with_points(self, grid: CellGrid, low: float, high: float, window: GridWindow | None = None) -> np.ndarray:
        """Cells, bool [H, W], that have one: the middle of an eighth lies in them, or any part of one of a thin
        thing."""
        thin = self._octants.between(low - self._reach[2], high + self._reach[2], self._thin)
        own = grid.mark(self._octants.between(low, high), window=window)
        return own | grid.mark(thin, self._reach[:2], window)


def unseen_surface(surface: np.ndarray, near_points: np.ndarray) -> np.ndarray:
    """Cells, bool [H, W], with a surface that nobody saw: it lies where what is behind one side of a thing meets space
    seen free from another, and no cell beside it may have a measured point in it (of maps that count points)."""
    if not near_points.any():
        return np.zeros_like(surface)
    return surface & (cv2.dilate(near_points.astype(np.uint8), _BESIDE) == 0)


def _thin_octants(octants: np.ndarray, lone: np.ndarray, voxel: float) -> np.ndarray:
    """Which octants [N, 3] lie in the voxels of points [M, 3]; both from the field's origin."""
    thin, own = (
        (v[:, 0] << 42) + (v[:, 1] << 21) + v[:, 2]
        for v in (np.floor(p / voxel).astype(np.int64) for p in (lone, octants))
    )
    return np.isin(own, thin)
