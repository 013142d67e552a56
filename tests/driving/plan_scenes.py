# SPDX-License-Identifier: Apache-2.0
"""Rooms of exact geometry, and the shortest ways through them by scipy: what the planner is measured by."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra

from ggslam.driving.plan_maps import FieldCells, PlanMap, WholeArray
from ggslam.driving.plan_settings import PlanSettings
from ggslam.driving.planner import Planner
from ggslam.driving.robot import Robot
from ggslam.jobs.plan.bands import band_cells
from ggslam.scene.poses import transform_points
from ggslam.volumes.esdf import DistanceField, FieldSettings
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import FREE_VALUE, FULL_WEIGHT, SIDE, VOXELS, TsdfMap


@dataclass(frozen=True)
class Column:
    """A solid whose sections are the same at all heights from `bottom` to `top`: a turned box, or a cylinder."""

    middle: tuple[float, float]
    half: tuple[float, float]
    turn: float
    bottom: float
    top: float
    is_round: bool

    def across(self, places: np.ndarray) -> np.ndarray:
        """Signed metres [N] from the section, of places [N, 2]."""
        x, y = places[:, 0] - self.middle[0], places[:, 1] - self.middle[1]
        if self.is_round:
            return np.hypot(x, y) - self.half[0]
        c, s = np.cos(self.turn), np.sin(self.turn)
        q = np.abs(np.stack([c * x + s * y, c * y - s * x], 1)) - np.array(self.half)
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed metres [N] from the solid, of points [N, 3]."""
        q = np.stack([self.across(points[:, :2]), np.maximum(self.bottom - points[:, 2], points[:, 2] - self.top)], 1)
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


@dataclass(frozen=True)
class Room:
    """The inside of a box from zero to `size` with solids in it."""

    size: tuple[float, float, float]
    solids: tuple[Column, ...]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed metres [N] from the nearest solid or wall, of points [N, 3]."""
        walls = np.minimum(points, np.array(self.size) - points).min(axis=1)
        return np.min([walls, *(solid.distance(points) for solid in self.solids)], axis=0)

    def across(self, places: np.ndarray, band: tuple[float, float]) -> np.ndarray:
        """Metres [N] across the floor from places [N, 2] to the nearest wall or solid that reaches into a band."""
        walls = np.minimum(places, np.array(self.size[:2]) - places).min(axis=1)
        met = [solid for solid in self.solids if solid.bottom <= band[1] and solid.top >= band[0]]
        return np.min([walls, *(solid.across(places) for solid in met)], axis=0)


def random_room(seed: int, size: tuple[float, float, float], walls: int, things: int) -> Room:
    """A room with walls that have doors, and things on the floor, from the ceiling and in the air."""
    rng = np.random.default_rng(seed)
    solids = []
    for number in range(walls):
        along, across = (0, 1) if number % 2 else (1, 0)
        place = size[across] * (number + 1) / (walls + 1) + rng.uniform(-0.3, 0.3)
        door, width = rng.uniform(0.8, size[along] - 0.8), rng.uniform(0.65, 1.1)
        for low, high in ((0.0, door - width / 2), (door + width / 2, size[along] * rng.uniform(0.7, 1))):
            if high > low + 0.1:
                middle, half = [0.0, 0.0], [0.0, 0.0]
                middle[along], half[along] = (low + high) / 2, (high - low) / 2
                middle[across], half[across] = place, 0.08
                solids.append(Column((middle[0], middle[1]), (half[0], half[1]), 0.0, 0.0, size[2], False))
    for _ in range(things):
        middle, half = rng.uniform(0.2, np.array(size[:2]) - 0.2), rng.uniform(0.1, 0.45, 2)
        height, kind = rng.uniform(0.3, 0.8) * size[2], rng.integers(3)
        bottom = (0.0, size[2] - height, rng.uniform(0, size[2] - 0.3))[kind]
        top = (height, size[2], bottom + 0.3)[kind]
        turn, is_round = rng.uniform(0, np.pi), bool(rng.random() < 0.4)
        solids.append(Column((middle[0], middle[1]), (half[0], half[1]), turn, bottom, top, is_round))
    return Room(size, tuple(solids))


Y_DOWN = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""T_floor_map of a map whose first camera was held level at the floor's origin."""


def room_tsdf(room: Room, voxel: float, top: float | None = None, T_floor_map: np.ndarray | None = None) -> TsdfMap:
    """A room as a volume, known up to the truncation behind surfaces; up to a height, or whole. T_floor_map [4, 4], of
    the map that it is in, only exchanges axes."""
    T = np.eye(4) if T_floor_map is None else T_floor_map
    tsdf = TsdfMap(TsdfSettings(voxel=voxel))
    edge, far = SIDE * voxel, np.array([*room.size[:2], room.size[2] if top is None else top]) + 0.2
    ends = np.array([np.full(3, -0.2), far]) @ T[:3, :3]
    ranges = [np.arange(np.floor(a / edge), np.ceil(b / edge)) for a, b in zip(ends.min(0), ends.max(0), strict=True)]
    blocks = np.stack(np.meshgrid(*ranges, indexing="ij"), -1).reshape(-1, 3).astype(np.int32)
    k, j, i = np.unravel_index(np.arange(VOXELS), (SIDE,) * 3)
    offsets = np.stack([i, j, k], -1) + 0.5
    limit = tsdf.settings.truncation
    for start in range(0, len(blocks), 500):
        at = blocks[start : start + 500]
        centres = (at[:, None] * SIDE + offsets[None]) * voxel
        distance = room.distance(transform_points(centres.reshape(-1, 3), T)).reshape(len(at), VOXELS)
        value = np.rint(np.clip(distance / limit, -1, 1) * FREE_VALUE)
        free = (value == FREE_VALUE).all(axis=1)
        weight = np.where(distance[~free] >= -limit, FULL_WEIGHT, 0)
        tsdf.write(at[~free], value=value[~free], weight=weight)
        tsdf.write_free(at[free], np.full(free.sum(), FULL_WEIGHT))
    return tsdf


def room_field(room: Room, voxel: float, top: float | None = None) -> DistanceField:
    """The distance field of `room_tsdf`."""
    field = DistanceField(room_tsdf(room, voxel, top), FieldSettings(max_distance=1.0))
    field.update()
    return field


class ShortestWays:
    """The shortest ways over the cells of a grid that are passable: 8 or 26 neighbours, by scipy's Dijkstra.

    Args:
        passable: bool [Y, X] or [Z, Y, X].
    """

    def __init__(self, passable: np.ndarray) -> None:
        self._number = np.full(passable.shape, -1)
        self._number[passable] = np.arange(passable.sum())
        rows, columns, lengths = [], [], []
        for step in np.ndindex(*(3,) * passable.ndim):
            shift = np.array(step) - 1
            if tuple(shift) <= (0,) * passable.ndim:
                continue  # the other way round
            here = tuple(slice(max(0, -d), n - max(0, d)) for d, n in zip(shift, passable.shape, strict=True))
            there = tuple(slice(max(0, d), n - max(0, -d)) for d, n in zip(shift, passable.shape, strict=True))
            both = passable[here] & passable[there]
            rows.append(self._number[here][both])
            columns.append(self._number[there][both])
            lengths.append(np.full(both.sum(), np.linalg.norm(shift), np.float32))
        entries = (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns)))
        n = int(passable.sum())
        self._graph: csr_matrix = coo_matrix(entries, (n, n)).tocsr()

    def lengths(self, start: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Cells [G] from a cell [2 or 3] (in the array's order) to goals [G, 2 or 3]; inf: no way."""
        found = dijkstra(self._graph, directed=False, indices=int(self._number[tuple(start)]))
        return np.asarray(found[self._number[tuple(goals.T)]])


def along(points: np.ndarray, step: float = 0.002) -> np.ndarray:
    """Points [M, 3] on a path through points [N, 3], no farther than `step` metres apart."""
    parts = []
    for a, b in zip(points[:-1], points[1:], strict=True):
        n = max(1, int(np.ceil(np.linalg.norm(b - a) / step)))
        parts.append(a + (b - a) * np.linspace(0, 1, n, endpoint=False)[:, None])
    return np.concatenate([*parts, points[-1:]])


@dataclass(frozen=True)
class Trial:
    """One pair of places.

    Attributes:
        exists: whether there is a way over cells whose exact clearance is enough.
        found: whether the planner found a path.
        ratio: length of the path by that of the shortest way over cells; NaN without both.
        missing: metres by which the path's least exact clearance is below what was asked for; negative: it is above.
        told: metres by which the planner's own least clearance is below what was asked for.
        milliseconds: of processor time.
    """

    exists: bool
    found: bool
    ratio: float
    missing: float
    told: float
    milliseconds: float


def room_planner(
    room: Room, voxel: float, fly: bool, clearance: float, settings: PlanSettings | None = None
) -> Planner:
    """A planner in a room's volume: in space, or on the floor for a robot 0.4 m high."""
    field = room_field(room, voxel, None if fly else 0.5)
    T = np.eye(4)
    if fly:
        return Planner(PlanMap("room", 3, voxel, T, FieldCells(field, 1), T), clearance, settings)
    low, cells = band_cells(field, T, Robot(), voxel, 1.0, False)
    T_grid_map = np.eye(4)
    T_grid_map[:2, 3] = -np.array(low)
    return Planner(PlanMap("room", 2, voxel, T_grid_map, WholeArray((0, 0, 0), cells), T), clearance, settings)


def trials(planner: Planner, room: Room, seed: int, starts: int, goals: int) -> list[Trial]:
    """Plans between random cells that are half a cell wider than asked, and compares with the exact room."""
    n, cell, asked = planner.map.dimensions, planner.map.cell, planner.costs.radius
    corners = planner.map.to_grid(np.array([(0.0, 0.0, 0.0), room.size]))
    first, last = planner.grid.cells_of(np.array([corners.min(0), corners.max(0)]))
    axes = [np.arange(first[a], last[a] + 1) if a < n else np.zeros(1, int) for a in range(3)]
    cells = np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], -1)
    centres = (cells.reshape(-1, 3) + 0.5) * cell
    centres[:, n:] = 0
    places = planner.map.to_map(centres)
    exact = exact_clearance(room, places, n).reshape(cells.shape[:3])
    exact = exact[0] if n == 2 else exact
    ways, rng = ShortestWays(exact >= asked), np.random.default_rng(seed)
    wide = np.argwhere(exact >= asked + cell / 2)
    found = []
    for start in wide[rng.integers(len(wide), size=starts)]:
        ends = wide[rng.integers(len(wide), size=goals)]
        shortest = cell * ways.lengths(start, ends)
        of = [places[np.ravel_multi_index(tuple(at), exact.shape)] for at in (start, *ends)]
        for end, length in zip(of[1:], shortest, strict=True):
            found.append(_trial(planner, room, of[0], end, float(length)))
    return found


def exact_clearance(room: Room, places: np.ndarray, dimensions: int) -> np.ndarray:
    """Metres [N] from places [N, 3] to the exact room, for who flies or a robot 0.4 m high."""
    return room.distance(places) if dimensions == 3 else room.across(places[:, :2], Robot().band)


def _trial(planner: Planner, room: Room, start: np.ndarray, end: np.ndarray, shortest: float) -> Trial:
    began = time.process_time()
    path = planner.plan(start, end)
    milliseconds = 1e3 * (time.process_time() - began)
    if not path.is_found:
        return Trial(np.isfinite(shortest), False, np.nan, np.nan, np.nan, milliseconds)
    least = float(exact_clearance(room, along(path.points), planner.map.dimensions).min())
    ratio = path.length / shortest if shortest > 0 and np.isfinite(shortest) else np.nan
    asked = path.asked
    return Trial(np.isfinite(shortest), True, ratio, asked - least, asked - path.least_clearance, milliseconds)
