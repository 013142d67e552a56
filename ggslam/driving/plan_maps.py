# SPDX-License-Identifier: Apache-2.0
"""What paths are planned on: a grid of clearances, whole or page by page, and where it lies in the map.

Robots that drive get the plane of their floor, those that fly all of space. Cells whose clearance is not a number may
not be entered: nobody has seen them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol

import numpy as np

from ggslam.driving.way_grid import BLOCK, Cell, cell_distances
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import inverse, transform_points
from ggslam.system.tuning import Tuning
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyMap
from ggslam.volumes.tsdf import SIDE

Box = tuple[Cell, np.ndarray]
"""First cell, and clearances float32 [Z, Y, X] (or [Y, X]) from there on, metres; NaN: may not be entered."""


class PlanMapTuning(Tuning):
    """How maps become grids."""

    page_blocks = {2: 4, 3: 6}
    """Edge of a page of an occupancy map, in blocks of the grid, by the number of dimensions."""
    blocks_at_once = 4096
    """Blocks of a distance field that are read at a time."""


class MapPages(Protocol):
    """Gives the cells of a map."""

    @property
    def page(self) -> int:
        """Edge of a page in blocks of the grid (`BLOCK`); 0: page (0, 0, 0) is all there is."""
        ...

    def read(self, page: Cell) -> Iterable[Box]:
        """The cells of a page."""
        ...

    def prepare(self, pages: list[Cell]) -> None:
        """Told which pages are likely to be read soon."""
        ...

    def close(self) -> None:
        """Lets files go."""
        ...


@dataclass(frozen=True)
class PlanMap:
    """A map for a planner.

    Attributes:
        name: what people call it.
        dimensions: 2: a plane to drive on; 3: space to fly in.
        cell: edge of a cell, metres.
        T_grid_map: float64 [4, 4], from the map's frame to the grid's, in whose plane z = 0 robots drive.
        pages: its cells.
        T_floor_map: float64 [4, 4], from the map's frame to that of the floor, z up.
    """

    name: str
    dimensions: int
    cell: float
    T_grid_map: np.ndarray
    pages: MapPages
    T_floor_map: np.ndarray

    def __enter__(self) -> PlanMap:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.pages.close()

    def to_grid(self, points: np.ndarray) -> np.ndarray:
        """Points [N, 3] of the map in the grid's frame."""
        return transform_points(np.asarray(points, np.float64).reshape(-1, 3), self.T_grid_map)

    def to_map(self, points: np.ndarray) -> np.ndarray:
        """Points [N, 3] of the grid in the map's frame."""
        return transform_points(np.asarray(points, np.float64).reshape(-1, 3), inverse(self.T_grid_map))


class InMemory:
    """Pages of a map that is in memory: nothing is to be prepared."""

    def prepare(self, pages: list[Cell]) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Nothing to do."""


@dataclass(frozen=True)
class WholeArray(InMemory):
    """All cells of a small map.

    Attributes:
        low: first cell.
        clearance: float32 [Z, Y, X] or [Y, X], metres.
    """

    low: Cell
    clearance: np.ndarray
    page: int = 0

    def read(self, page: Cell) -> Iterable[Box]:
        """The cells."""
        return [(self.low, self.clearance)]


class FieldCells(InMemory):
    """Space as a distance field has it: the distances at voxels' centres, of every `step`th along each axis.

    Args:
        field: up to date.
        step: 1, 2, 4 or 8.
    """

    page = 0

    def __init__(self, field: DistanceField, step: int) -> None:
        self.field, self.step = field, step

    def read(self, page: Cell) -> Iterable[Box]:
        """The cells of all blocks."""
        yield from self.of_blocks(self.field.coordinates())

    def of_blocks(self, coordinates: np.ndarray) -> Iterable[Box]:
        """The cells of the blocks at coordinates [n, 3]."""
        for start in range(0, len(coordinates), PlanMapTuning.blocks_at_once):
            at = coordinates[start : start + PlanMapTuning.blocks_at_once]
            yield from block_boxes(at, self.field.read(at), self.step)


def block_boxes(coordinates: np.ndarray, distance: np.ndarray, step: int) -> Iterable[Box]:
    """Blocks of voxels as cells `step` voxels wide, whose centres are those of the voxels `step // 2` from their lower
    corner (half a voxel off the middle; see `field_frame`).

    Args:
        coordinates: int32 [n, 3].
        distance: float32 [n, 512], metres.
        step: voxels, a divisor of 8.
    """
    values = distance.reshape(-1, SIDE, SIDE, SIDE)[:, step // 2 :: step, step // 2 :: step, step // 2 :: step]
    cells = (coordinates * (SIDE // step)).tolist()
    yield from (((x, y, z), block) for (x, y, z), block in zip(cells, values, strict=True))


def field_frame(origin: np.ndarray, voxel: float, step: int) -> np.ndarray:
    """T_grid_map [4, 4] of the cells of a field's blocks: cells' centres are where the distances were taken."""
    T = np.eye(4)
    T[:3, 3] = -np.asarray(origin) - (0.0 if step == 1 else voxel / 2)
    return T


class OccupancySpace(InMemory):
    """Space as an occupancy map has it. Clearances are those to the faces of occupied voxels.

    Args:
        occupancy: the map.
        reach: metres; what is farther from obstacles counts as this far.
        unknown: whether voxels that nobody saw may be entered.
    """

    page = PlanMapTuning.page_blocks[3]

    def __init__(self, occupancy: OccupancyMap, reach: float, unknown: bool) -> None:
        self.occupancy, self.unknown = occupancy, unknown
        self._reach = _reach_cells(reach, occupancy.resolution)
        box = occupancy.summary().known_box
        known = np.zeros((2, 3)) if box is None else box - occupancy.origin
        self._known = _cell_box(known, occupancy.resolution)

    def read(self, page: Cell) -> Iterable[Box]:
        """The cells of a page."""
        low, high = _page_box(page, self.page * BLOCK[3], self._known, 3)
        if (high <= low).any():
            return []
        states = self._states(low - self._reach, high + self._reach)
        inner = (slice(self._reach, -self._reach),) * 3
        clearance = cell_distances(states == OCCUPIED, self.occupancy.resolution, self._reach, self.occupancy.context)[
            inner
        ]
        if not self.unknown:
            clearance = np.where(states[inner] == UNKNOWN, np.float32(np.nan), clearance)
        return [(_cell(low), clearance)]

    def _states(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        axes = [(np.arange(a, b) + 0.5) * self.occupancy.resolution for a, b in zip(low, high, strict=True)]
        z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
        points = np.stack([x, y, z], -1).reshape(-1, 3) + self.occupancy.origin
        return self.occupancy.states(points).reshape(z.shape)


class OccupancyFloor(InMemory):
    """The floor under an occupancy map: a cell is occupied if a voxel between two heights over it is, and free if one
    was seen and none is occupied.

    Args:
        occupancy: the map.
        T_floor_map: float64 [4, 4].
        band: lowest and highest obstacle, metres above the floor. Obstacles in the voxels of the floor cannot be told
            from it.
        reach: metres; what is farther from obstacles counts as this far.
        unknown: whether cells that nobody saw may be entered.
    """

    page = PlanMapTuning.page_blocks[2]

    def __init__(
        self, occupancy: OccupancyMap, T_floor_map: np.ndarray, band: tuple[float, float], reach: float, unknown: bool
    ) -> None:
        self.occupancy, self.unknown, self._band = occupancy, unknown, band
        self._T_map_floor = inverse(T_floor_map)
        self._reach = _reach_cells(reach, occupancy.resolution)
        known = occupancy.summary().known_box
        corners = np.zeros((1, 3)) if known is None else known[np.array(list(np.ndindex(2, 2, 2))), [0, 1, 2]]
        on_floor = transform_points(corners, T_floor_map)
        self._known = _cell_box(np.array([on_floor.min(0), on_floor.max(0)]), occupancy.resolution)

    def read(self, page: Cell) -> Iterable[Box]:
        """The cells of a page."""
        low, high = _page_box(page, self.page * BLOCK[2], self._known, 2)
        if (high[:2] <= low[:2]).any():
            return []
        occupied, free = self._columns(low - self._reach, high + self._reach)
        inner = (slice(self._reach, -self._reach),) * 2
        clearance = cell_distances(occupied, self.occupancy.resolution, self._reach, self.occupancy.context)[inner]
        if not self.unknown:
            clearance = np.where((occupied | free)[inner], clearance, np.float32(np.nan))
        return [(_cell(low), clearance)]

    def _columns(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whether columns have an occupied and a free voxel in the band, bool [Y, X]."""
        voxel = self.occupancy.resolution
        x, y = ((np.arange(low[a], high[a]) + 0.5) * voxel for a in (0, 1))
        place = np.zeros((len(y), len(x), 3))
        place[..., 0], place[..., 1] = x, y[:, None]
        occupied, free = np.zeros((2, len(y), len(x)), bool)
        # The voxel of the floor reaches up to a voxel above it.
        bottom = max(self._band[0] + voxel / 2, voxel)
        top = max(bottom, self._band[1] - voxel / 2)
        for height in np.linspace(bottom, top, int(np.ceil((top - bottom) / voxel)) + 1):
            place[..., 2] = height
            points = transform_points(place.reshape(-1, 3), self._T_map_floor)
            states = self.occupancy.states(points).reshape(occupied.shape)
            occupied |= states == OCCUPIED
            free |= states == FREE
        return occupied, free


def floor_cells(
    occupied: np.ndarray, free: np.ndarray, cell: float, reach: float, unknown: bool, context: NativeContext
) -> np.ndarray:
    """Clearances float32 [Y, X] of a floor's cells, row 0 where y is smallest, from which are occupied and free, bool
    [Y, X]; see `OccupancyFloor`."""
    clearance = cell_distances(occupied, cell, _reach_cells(reach, cell), context)
    return clearance if unknown else np.where(occupied | free, clearance, np.float32(np.nan))


def _reach_cells(reach: float, cell: float) -> int:
    return int(np.ceil(reach / cell)) + 1


def _cell(at: np.ndarray) -> Cell:
    x, y, z = (int(v) for v in at)
    return x, y, z


def _cell_box(box: np.ndarray, cell: float) -> np.ndarray:
    """First cell, and that behind the last, of a box [2, 3] in metres: int [2, 3]."""
    return np.stack([np.floor(box[0] / cell + 1e-6), np.ceil(box[1] / cell - 1e-6)]).astype(int)


def _page_box(page: Cell, edge: int, known: np.ndarray, dimensions: int) -> tuple[np.ndarray, np.ndarray]:
    """The part of a page that may be known: first cell, and that behind the last."""
    low = np.maximum(np.array(page) * edge, known[0])
    high = np.minimum((np.array(page) + 1) * edge, known[1])
    low[dimensions:], high[dimensions:] = 0, 1
    return low, high
