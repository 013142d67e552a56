# SPDX-License-Identifier: Apache-2.0
"""The band of heights that a robot passes through: where it meets obstacles, what is free, how far obstacles are.

A volume's distances are three-dimensional: low above the floor they tell how near the floor is. What counts for a robot
on the floor is how far it is, across the floor, to the nearest thing at its own heights. Stairs that lead down and
holes have nothing at these heights: they are told by free space that was seen below the floor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ggslam.abi.core import BEHIND_BIT, SEEN_BIT
from ggslam.driving.band_sources import band_source
from ggslam.driving.robot import Robot
from ggslam.errors import InputError
from ggslam.scene.poses import inverse
from ggslam.system.tuning import Tuning
from ggslam.volumes.cell_field import AnyField
from ggslam.volumes.cell_grid import CellGrid, GridWindow, SlicePlane
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.seen_surface import unseen_surface
from ggslam.volumes.tsdf import SIDE


class BandTuning(Tuning):
    """How bands are looked at."""

    reach_voxels = 0.75
    """Distance from a surface point in voxels up to which a cell is occupied: with less, walls have holes where cells
    are smaller than voxels, for the points are up to 1.4 voxels apart."""
    cells_at_once = 1 << 20
    """Cells whose distances are computed together."""


@dataclass(frozen=True)
class BandMap:
    """What a robot meets, cell by cell.

    Attributes:
        grid: the cells, on the floor.
        heights: lowest and highest obstacle that counts, metres above the floor.
        occupied: bool [H, W], whether a cell has a surface in it: a surface point, or a measured point, between these
            heights lies in it or within half a cell (three quarters of a voxel, if
            that is more) of its centre; or whether the floor falls away there, see `HeightLayers.drops`.
        known: bool [H, W], whether it was seen at one of the heights at least.
        behind: bool [H, W], whether it is behind a surface at one of them, at one that no point was measured near, or
            may have a measured point in it: not free, whatever is known.
        distance: float32 [H, W], metres across the floor from a cell's centre to the nearest of the surface points, or
            cells where the floor falls away; inf if there is none.
        points: float64 [P, 2], x and y on the plane of the surface points.
    """

    grid: CellGrid
    heights: tuple[float, float]
    occupied: np.ndarray
    known: np.ndarray
    behind: np.ndarray
    distance: np.ndarray
    points: np.ndarray

    @property
    def free(self) -> np.ndarray:
        """Cells that were seen, with no surface in them and not behind one, bool [H, W]. A cell that was seen at some
        of the heights only may be free."""
        return self.known & ~self.occupied & ~self.behind

    @property
    def plane(self) -> SlicePlane:
        """Where the cells are."""
        return self.grid.plane

    @property
    def resolution(self) -> float:
        """Edge of a cell, metres."""
        return self.grid.resolution


class HeightLayers:
    """What a volume has above a floor, layer by layer; bands of several robots are cut from it. It stands for the
    volume as it is when the object is made.

    Args:
        field: up to date; cells on disk are read a few at a time.
        plane: of the floor, its normal up.
        resolution: edge of a cell, metres.
        floor_seen: whether the plane is a floor, and no guess: what is free below it is then no floor.

    Raises:
        InputError: a resolution that is not positive, or more than 50 million cells.
    """

    def __init__(self, field: AnyField, plane: SlicePlane, resolution: float, floor_seen: bool = True) -> None:
        self.grid = CellGrid.over(plane, resolution)
        self._field, self._floor_seen = field, floor_seen
        self._source = band_source(field, self.grid)
        self._drops: dict[float, np.ndarray] = {}
        edge = SIDE * field.voxel
        middles = (field.coordinates() + 0.5) * edge + field.origin
        heights = plane.coordinates(middles)[:, 2]
        self._reach = (heights.min() - edge, heights.max() + edge) if len(heights) else (0.0, 0.0)

    def band(self, robot: Robot) -> BandMap:
        """What a robot meets, and where it would fall."""
        found = self._between(*robot.band, self._floor_seen)
        drops = self.drops(robot.step)
        if not drops.any():
            return found
        distance = np.minimum(found.distance, self._distance(self.grid.outline(drops)))
        distance[drops] = np.minimum(distance[drops], 0)
        return replace(found, occupied=found.occupied | drops, distance=distance)

    def drops(self, step: float) -> np.ndarray:
        """Cells, bool [H, W], where the floor falls away by more than `step` metres: a view has seen free space so far
        below the plane, and a voxel farther. Where nobody looked down, none is known. None at all if the plane is no
        floor that was seen."""
        if not self._floor_seen:
            return np.zeros(self.grid.shape, bool)
        # Half a voxel more: the voxel around a place that low reaches half its edge up.
        layer = np.floor(-step / self._field.voxel - 0.5 + 1e-6) * self._field.voxel
        if layer not in self._drops:
            seen = self._source.look(layer, layer)
            self._drops[layer] = ((seen & SEEN_BIT) > 0) & ((seen & BEHIND_BIT) == 0)
        return self._drops[layer]

    def between(self, low: float, high: float) -> BandMap:
        """What there is between two heights above the floor, metres; a robot that meets all of it.

        Raises:
            InputError: the lower one is not the first.
        """
        return self._between(low, high, False)

    def _between(self, low: float, high: float, on_floor: bool) -> BandMap:
        if not low <= high:
            raise InputError(f"expected two heights, the lower first, found {low} and {high}")
        low, high = max(low, min(self._reach[0], high)), min(high, max(self._reach[1], low))
        seen = self._source.look(low, high)
        known, behind = (seen & SEEN_BIT) > 0, (seen & BEHIND_BIT) > 0
        near, measured, sites = self._source.surface(low, high, on_floor)
        sited = self.grid.mark(sites)
        sites = self._outside(sites, unseen_surface(sited, near))
        points = np.concatenate([sites, self.grid.centres_of(measured & ~self.grid.mark(sites))])
        distance = self._distance(points)
        reached = distance <= max(self.grid.resolution / 2, BandTuning.reach_voxels * self._field.voxel)
        unseen = unseen_surface(sited | reached, near)
        occupied = ((sited | reached) & ~unseen) | measured
        return BandMap(self.grid, (low, high), occupied, known, behind | unseen | near, distance, points)

    def _outside(self, places: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Those of places [N, 2] that lie in none of some cells, bool [H, W]."""
        row, column, inside = self.grid.cells_of(places)
        left_out = np.zeros(len(places), bool)
        left_out[inside] = cells[row[inside], column[inside]]
        return places[~left_out]

    def _distance(self, points: np.ndarray) -> np.ndarray:
        found = np.full(self.grid.shape, np.inf, np.float32)
        if not len(points):
            return found
        tree, (height, width) = cKDTree(points, compact_nodes=False, balanced_tree=False), self.grid.shape
        rows = max(1, BandTuning.cells_at_once // width)
        for first in range(0, height, rows):
            part = GridWindow(first, 0, (min(rows, height - first), width))
            found[part.slices] = tree.query(self.grid.centres(part).reshape(-1, 2), workers=2)[0].reshape(part.shape)
        return found


def floor_plane(field: DistanceField, T_floor_map: np.ndarray) -> SlicePlane:
    """The floor as far as a field's blocks reach: z = 0 of the frame that T_floor_map [4, 4] leads to."""
    T_map_floor = inverse(np.asarray(T_floor_map, np.float64))
    edge = SIDE * field.voxel
    corners = np.concatenate([field.coordinates() + shift for shift in np.ndindex(2, 2, 2)]) * edge + field.origin
    plane = SlicePlane(T_map_floor[:3, 3], T_map_floor[:3, 0], T_map_floor[:3, 1], (0.0, 0.0), (0.0, 0.0))
    at = plane.coordinates(corners)[:, :2] if len(corners) else np.zeros((1, 2))
    (x0, y0), (x1, y1) = at.min(axis=0).tolist(), at.max(axis=0).tolist()
    return SlicePlane(plane.origin, plane.x_axis, plane.y_axis, (x0, y0), (x1, y1))


def band_map(
    field: DistanceField, floor: SlicePlane | np.ndarray, robot: Robot, resolution: float, floor_seen: bool = True
) -> BandMap:
    """What a robot meets on a floor.

    Args:
        field: up to date.
        floor: its plane, the normal up, or T_floor_map [4, 4].
        robot: what drives.
        resolution: edge of a cell, metres.
        floor_seen: whether it is a floor, and no guess, see `HeightLayers`.

    Raises:
        InputError: a resolution that is not positive, or more than 50 million cells.
    """
    plane = floor if isinstance(floor, SlicePlane) else floor_plane(field, floor)
    return HeightLayers(field, plane, resolution, floor_seen).band(robot)
