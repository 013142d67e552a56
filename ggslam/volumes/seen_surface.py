# SPDX-License-Identifier: Apache-2.0
"""What was seen of surfaces, as it lies above a plane: the points that distances are measured from, and the measured
points beside them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from ggslam.volumes.cell_grid import CellGrid, SlicePlane
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.measured_points import measured_octants

_BESIDE = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


@dataclass(frozen=True)
class SeenSurface:
    """Surfaces above a plane; positions are x, y and height on it, metres.

    Attributes:
        sites: float64 [S, 3], surface points of a distance field.
        octants: float64 [N, 3], middles of the eighths of voxels that points were measured in.
        thin: bool [N], whether such an eighth is of a voxel that is surface for its points alone.
        reach: [3], how far an eighth reaches from its middle.
    """

    sites: np.ndarray
    octants: np.ndarray
    thin: np.ndarray
    reach: np.ndarray

    @staticmethod
    def of(field: DistanceField, plane: SlicePlane) -> SeenSurface:
        """What a field and its TSDF have."""
        points, normals = field.surface()
        # Seen from the field's origin, so that a map far from zero gives the same bits.
        sites, octants = (points - field.origin).astype(np.float32).astype(float), measured_octants(field.tsdf)
        plane = replace(plane, origin=plane.origin - field.origin)
        thin = _thin_octants(octants, sites[~normals.any(1)], field.voxel)
        reach = field.voxel / 4 * np.abs(np.stack([plane.x_axis, plane.y_axis, plane.normal])).sum(1)
        return SeenSurface(plane.coordinates(sites), plane.coordinates(octants), thin, reach)

    def near_points(self, grid: CellGrid, low: float, high: float) -> np.ndarray:
        """Cells, bool [H, W], that may have a measured point in them between two heights: none of them is free."""
        return grid.mark(self._between(low, high, self.reach[2]), self.reach[:2])

    def with_points(self, grid: CellGrid, low: float, high: float) -> np.ndarray:
        """Cells, bool [H, W], that have one: the middle of an eighth lies in them, or any part of one of a thin
        thing."""
        marked = grid.mark(self._between(low, high))
        return marked | grid.mark(self._between(low, high, self.reach[2], self.thin), self.reach[:2])

    def _between(self, low: float, high: float, reach: float = 0.0, which: np.ndarray | None = None) -> np.ndarray:
        octants = self.octants if which is None else self.octants[which]
        heights = octants[:, 2]
        return octants[(heights >= low - reach) & (heights <= high + reach)]


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
