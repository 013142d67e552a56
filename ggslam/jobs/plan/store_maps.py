# SPDX-License-Identifier: Apache-2.0
"""Maps to plan on out of a grid store's volumes: cells are read as a search reaches them, and those on the way to the
goal ahead of it."""

from __future__ import annotations

import io
import math
from collections import OrderedDict
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Final

import numpy as np

from ggslam.driving.plan_maps import Box, FieldCells, PlanMap, PlanMapTuning, block_boxes, field_frame
from ggslam.driving.robot import Robot
from ggslam.driving.way_grid import BLOCK, Cell
from ggslam.errors import FormatError
from ggslam.jobs.plan.bands import band_cells, floor_of_field
from ggslam.jobs.submaps.visit_records import read_record
from ggslam.jobs.volumes.store_volumes import ESDF, TSDF
from ggslam.native.loader import NativeContext
from ggslam.scene.arrays import arrays_of
from ggslam.scene.poses import inverse, transform_points, translation
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import INDEX, GridStore
from ggslam.system.tuning import Tuning
from ggslam.volumes.esdf import DistanceField, FieldSettings
from ggslam.volumes.tsdf import SIDE
from ggslam.volumes.tsdf_file import blocks_within, join_blocks, tsdf_of_arrays

VOLUMES: Final = "volumes"
"""Folder of the volumes in a run's or a store's."""
Arrays = dict[str, np.ndarray]


class StoreMapTuning(Tuning):
    """Memory, and how much is read at a time."""

    cells_in_memory = 64
    """Cells whose volumes are kept in memory."""
    floor_page_blocks = 2
    """Edge of a page of the floor, in blocks of the grid."""
    floor_around_m = 2.0
    """How far around a start the floor is looked for, in metres."""


class StoreCells:
    """The volumes of a store's cells, read once each while they are among the last ones asked for.

    Args:
        path: of the store of volumes.
    """

    def __init__(self, path: Path) -> None:
        self.store = GridStore.open(path)
        self.read: set[CellKey] = set()
        """Cells that were read so far."""
        self.context = NativeContext()
        self._held: OrderedDict[tuple[CellKey, str], Future[Arrays]] = OrderedDict()
        self._reader = ThreadPoolExecutor(1, "read-ahead")

    def close(self) -> None:
        """Ends reading ahead."""
        self._reader.shutdown(cancel_futures=True)
        self.store.close()

    def within(self, low: np.ndarray, high: np.ndarray, part: str) -> list[CellKey]:
        """Cells with a part that overlap a box [3], [3] in metres, or nearly so: blocks reach over a cell's border."""
        middle, spacing = (low + high) / 2, self.store.grid.spacing
        reach = float(np.linalg.norm((high - low) / 2)) + spacing * math.sqrt(3)
        near, spans = self.store.part_versions(part, middle, reach), self.store.grid.spans
        return sorted(
            key for key in near
            if ((np.array(key) - 0.5) * spacing <= high + spacing / 8)[spans].all()
            and ((np.array(key) + 0.5) * spacing >= low - spacing / 8)[spans].all()
        )  # fmt: skip

    def prepare(self, keys: list[CellKey], part: str) -> None:
        """Reads cells in the background."""
        for key in keys:
            self._ask(key, part)

    def arrays(self, key: CellKey, part: str) -> Arrays:
        """A cell's part."""
        found = self._ask(key, part).result()
        while len(self._held) > StoreMapTuning.cells_in_memory:
            self._held.popitem(last=False)
        return found

    def _ask(self, key: CellKey, part: str) -> Future[Arrays]:
        if (key, part) not in self._held:
            self._held[key, part] = self._reader.submit(self._load, key, part)
        self._held.move_to_end((key, part))
        return self._held[key, part]

    def _load(self, key: CellKey, part: str) -> Arrays:
        self.read.add(key)
        held, what = io.BytesIO(self.store.get(key, part)), f"{self.store.path}: cell {key}: no volumes"
        return arrays_of(held, what, lambda found: {name: found[name] for name in found.files})

    def field(self, low: np.ndarray, high: np.ndarray, reach: float) -> DistanceField | None:
        """The distance field of a box, right within it as far as `reach` metres; None: there is nothing."""
        parts = []
        for key in self.within(low - reach, high + reach, TSDF):
            arrays = self.arrays(key, TSDF)
            edge = SIDE * _voxel_of(arrays, self.store.path)
            ends = (np.floor((low - reach) / edge) - 1, np.floor((high + reach) / edge) + 1)
            parts.append(blocks_within(arrays, *(end.astype(int) for end in ends)))
        if not any(len(part["dense"]) + len(part["free"]) for part in parts):
            return None
        tsdf = tsdf_of_arrays(join_blocks(parts), self.store.path, self.context)
        field = DistanceField(tsdf, FieldSettings(max_distance=max(2 * tsdf.settings.voxel, reach)))
        field.update()
        return field


class StoreSpace:
    """Space as a store's volumes have it; distances are those of its cells, or are found anew where they have none.

    Args:
        cells: the store's.
        step: voxels in a cell of the grid.
        voxel: their edge, metres.
        reach: distance from obstacles beyond which all are the same, metres.
    """

    page = PlanMapTuning.page_blocks[3]

    def __init__(self, cells: StoreCells, step: int, voxel: float, reach: float) -> None:
        self.cells, self.step, self._reach = cells, step, reach
        self._edge = SIDE * voxel

    def close(self) -> None:
        """Closes the store."""
        self.cells.close()

    def prepare(self, pages: list[Cell]) -> None:
        """Reads the cells of pages in the background."""
        for page in pages:
            low, high = self._box(page)
            self.cells.prepare(self.cells.within(low, high, ESDF), ESDF)

    def read(self, page: Cell) -> Iterable[Box]:
        """The cells of a page."""
        low, high = self._box(page)
        first, behind = (np.rint(end / self._edge).astype(int) for end in (low, high))
        there = self.cells.within(low, high, TSDF)
        distances = self.cells.within(low, high, ESDF)
        if set(distances) < set(there):
            field = self.cells.field(low, high, self._reach)
            if field is not None:
                at = field.coordinates()
                yield from FieldCells(field, self.step).of_blocks(at[((at >= first) & (at < behind)).all(1)])
            return
        for key in distances:
            arrays = self.cells.arrays(key, ESDF)
            at, distance = _distances(arrays, key, self.cells.store.path)
            inside = ((at >= first) & (at < behind)).all(1)
            yield from block_boxes(at[inside], distance[inside], self.step)

    def _box(self, page: Cell) -> tuple[np.ndarray, np.ndarray]:
        size = self.page * BLOCK[3] // (SIDE // self.step) * self._edge
        return np.array(page) * size, (np.array(page) + 1) * size


class StoreFloor:
    """The floor of a store's volumes, for a robot that drives.

    Args:
        cells: the store's.
        T_floor_map: float64 [4, 4].
        robot: what drives.
        cell: edge of a cell of the grid, metres.
        reach: distance from obstacles beyond which all are the same, metres.
        unknown: whether cells that nobody saw may be entered.
    """

    page = StoreMapTuning.floor_page_blocks

    def __init__(
        self, cells: StoreCells, T_floor_map: np.ndarray, robot: Robot, cell: float, reach: float, unknown: bool
    ) -> None:
        self.cells, self._T_floor_map, self._robot = cells, T_floor_map, robot
        self._cell, self._unknown, self._apron = cell, unknown, int(math.ceil(reach / cell)) + 1

    def close(self) -> None:
        """Closes the store."""
        self.cells.close()

    def prepare(self, pages: list[Cell]) -> None:
        """Reads the cells of pages in the background."""
        for page in pages:
            self.cells.prepare(self.cells.within(*self._box(page), TSDF), TSDF)

    def read(self, page: Cell) -> Iterable[Box]:
        """The cells of a page."""
        field = self.cells.field(*self._box(page), self._apron * self._cell)
        if field is None:
            return []
        size, apron = self.page * BLOCK[2], self._apron
        first = np.array(page[:2]) * size
        low, high = (first - apron) * self._cell, (first + size + apron) * self._cell
        extent = ((float(low[0]), float(low[1])), (float(high[0]), float(high[1])))
        _, clearance = band_cells(
            field, self._T_floor_map, self._robot, self._cell, apron * self._cell, self._unknown, extent
        )
        return [((int(first[0]), int(first[1]), 0), clearance[apron : apron + size, apron : apron + size])]

    def _box(self, page: Cell) -> tuple[np.ndarray, np.ndarray]:
        """The box around a page's part of the robot's band, in the map's frame."""
        edge, reach = self.page * BLOCK[2] * self._cell, self._apron * self._cell
        low = np.array([page[0] * edge - reach, page[1] * edge - reach, self._robot.band[0]])
        high = np.array([(page[0] + 1) * edge + reach, (page[1] + 1) * edge + reach, self._robot.band[1]])
        corners = np.array([low, high])[np.array(list(np.ndindex(2, 2, 2))), [0, 1, 2]]
        in_map = transform_points(corners, inverse(self._T_floor_map))
        return in_map.min(axis=0), in_map.max(axis=0)


def is_store(path: Path) -> bool:
    """Whether a folder is a grid store."""
    return (path / INDEX).is_file()


def open_store_map(
    path: Path, robot: Robot, fly: bool, cell_of: Callable[[float], float], reach: float, unknown: bool,
    start: np.ndarray,
) -> PlanMap:  # fmt: skip
    """The map of a store's volumes.

    Args:
        path: of the store, or of its volumes.
        robot: that drives.
        fly: whether it flies instead.
        cell_of: edge of cells by that of voxels, metres.
        reach: distance from obstacles beyond which all are the same, metres.
        unknown: whether what nobody saw may be entered.
        start: [3], around which the floor is looked for.

    Raises:
        FormatError: the store has no volumes, or is damaged.
    """
    inside = is_store(path / VOLUMES)
    source, volumes = (path, path / VOLUMES) if inside else (path.parent, path)
    cells = StoreCells(volumes)
    keys = cells.within(start - StoreMapTuning.floor_around_m, start + StoreMapTuning.floor_around_m, TSDF)
    keys = keys or [key for key in cells.store.cells() if TSDF in cells.store.cell(key).parts][:1]
    if not keys:
        raise FormatError(f"{path}: has no volumes: `ggslam volumes {path}` makes them")
    voxel = _voxel_of(cells.arrays(keys[0], TSDF), volumes)
    T_floor_map = _floor_around(cells, source, start)
    name, cell = path.name, cell_of(voxel)
    if fly:
        step = max(k for k in (1, 2, 4, 8) if k == 1 or k * voxel <= cell * 1.001)
        space = StoreSpace(cells, step, voxel, reach)
        return PlanMap(name, 3, step * voxel, field_frame(np.zeros(3), voxel, step), space, T_floor_map)
    floor = StoreFloor(cells, T_floor_map, robot, cell, reach, unknown)
    return PlanMap(name, 2, cell, T_floor_map, floor, T_floor_map)


def _floor_around(cells: StoreCells, source: Path, start: np.ndarray) -> np.ndarray:
    """T_floor_map [4, 4] from the surfaces around a start, and how the cameras of the store's visits were held."""
    around = StoreMapTuning.floor_around_m
    field = cells.field(start - around, start + around, 0.2)
    if field is None:
        return translation(-np.asarray(start, np.float64))
    poses: list[np.ndarray] = []
    if is_store(source):
        with GridStore.open(source) as store:
            for visit in store.visits():
                record = read_record(store, visit)
                poses += [] if record is None else list(record.poses.values())
    near = [T for T in poses if np.linalg.norm(T[:3, 3] - start) < 2 * around] or poses
    return floor_of_field(field, np.array(near) if near else None)


def _voxel_of(arrays: Arrays, path: Path) -> float:
    try:
        values = dict(zip(arrays["setting_names"].tolist(), arrays["setting_values"].tolist(), strict=True))
        voxel = float(values["voxel"])
    except (KeyError, TypeError, ValueError):
        voxel = math.nan
    if not 1e-4 < voxel < 1e3:
        raise FormatError(f"{path}: a cell's volumes are damaged: they have no voxel size")
    return voxel


def _distances(arrays: Arrays, key: CellKey, path: Path) -> tuple[np.ndarray, np.ndarray]:
    at, distance = arrays.get("coordinates"), arrays.get("distance")
    if at is None or distance is None or at.ndim != 2 or at.shape[1] != 3 or distance.shape != (len(at), SIDE**3):
        raise FormatError(f"{path}: cell {key}: its distances are damaged")
    return at.astype(np.int64), np.asarray(distance, np.float32)
