# SPDX-License-Identifier: Apache-2.0
"""Plans paths for a robot: the cheapest way over cells, pulled tight, smoothed along the field's gradient.

No piece of a path is nearer to an obstacle than was asked for: the interpolated clearance is looked at all along it,
also after smoothing, which moves a point only where both its pieces stay clear.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from ggslam.driving.plan_maps import FieldCells, PlanMap
from ggslam.driving.plan_settings import PlanSettings
from ggslam.driving.way_grid import Cell, WayCosts, WayGrid, cell_distances
from ggslam.errors import InputError
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import transform_points
from ggslam.system.tuning import Tuning


class PlannerTuning(Tuning):
    """How paths are refined and refusals explained."""

    spacing_cells = 2.0
    """Distance between points of a path, in cells."""
    near_m = 2.0
    """How far around a start or goal that does not fit a place that does is looked for, in metres."""
    near_cells = {2: 200, 3: 50}
    """The same in cells, at most, by the number of dimensions."""
    pages_ahead = 2
    """Pages towards the goal that are prepared while the search goes on."""
    touching = 1e-3
    """Clearance below which a place is in an obstacle, in metres."""


_NO_WAY = "no way"


@dataclass(frozen=True)
class PlannedPath:
    """A path, or why there is none.

    Attributes:
        points: float64 [N, 3], metres in the map's frame, from start to goal; N = 0: there is no path.
        clearance: float32 [N], metres from the points to the nearest obstacle.
        yaw: float64 [N], radians from the floor frame's x axis to where a robot that drives looks; None: it flies.
        asked: least clearance that was asked for, metres.
        least_clearance: along the whole path, metres; 0 without a path.
        reason: why there is no path; None: there is one.
        narrowest: [3], where the widest way is narrower than what was asked for; None: there is a path, or no such way.
        milliseconds: that planning took, reading the map not counted.
        cells: that the search looked at.
        pages: of the map that were read for it.
    """

    points: np.ndarray
    clearance: np.ndarray
    yaw: np.ndarray | None
    asked: float
    least_clearance: float
    reason: str | None = None
    narrowest: np.ndarray | None = None
    milliseconds: float = 0.0
    cells: int = 0
    pages: int = 0

    @property
    def is_found(self) -> bool:
        """Whether there is a path."""
        return self.reason is None

    @property
    def length(self) -> float:
        """Metres."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    def in_frame(self, T_to_map: np.ndarray) -> PlannedPath:
        """The path in another frame."""
        narrowest = None if self.narrowest is None else transform_points(self.narrowest[None], T_to_map)[0]
        return replace(self, points=transform_points(self.points, T_to_map), narrowest=narrowest)


class Planner:
    """Plans on a map that may change. One caller at a time.

    Args:
        plan_map: where to plan.
        clearance: least distance between the robot's middle and obstacles, metres.
        settings: what paths are like.
        T_told_map: from the map's frame to that in which reasons name places, [4, 4]; None: the map's.
    """

    def __init__(
        self, plan_map: PlanMap, clearance: float, settings: PlanSettings | None = None,
        T_told_map: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        if not 0 <= clearance < 1e4:
            raise InputError(f"clearance: expected 0 to 10000 m, found {clearance}")
        self.map, self.settings = plan_map, settings or PlanSettings()
        self._T_told_map = np.eye(4) if T_told_map is None else T_told_map
        self.costs = WayCosts(float(clearance), self.settings.margin, self.settings.weight)
        self.grid = WayGrid(plan_map.dimensions, plan_map.cell, plan_map.pages.page)
        self.pages = 0
        """Pages of the map that were read."""
        self._reading, self._goal = 0.0, np.zeros(3)
        self._reach_cells = int(np.ceil((self.costs.radius + self.costs.margin) / plan_map.cell)) + 1
        self._context = NativeContext(1)  # waking a thread takes longer than an obstacle
        self._obstacles: list[np.ndarray] = []
        if not self.grid.page:
            self._read_page((0, 0, 0))

    def plan(self, start: np.ndarray, goal: np.ndarray, explain: bool = True) -> PlannedPath:
        """Plans a path.

        Args:
            start, goal: [3], metres in the map's frame. Robots that drive start and end on the floor below or above.
            explain: whether the widest way is looked for where there is no path, which takes several times as long as
                finding out that there is none.

        Raises:
            InputError: a place that is none.
        """
        began, read, self._reading = time.perf_counter(), self.pages, 0.0
        ends = self.map.to_grid(np.array([_place("start", start), _place("goal", goal)]))
        ends[:, self.map.dimensions :] = 0
        self._goal, narrowest, points, cells = ends[1], None, None, 0
        reason = self._refusal("start", ends[0]) or self._refusal("goal", ends[1])
        if reason is None:
            points, cells, reached = self._search(ends)
            if points is None:
                reason, narrowest = self._explain(ends, reached) if explain else (_NO_WAY, None)
        milliseconds = 1e3 * (time.perf_counter() - began - self._reading)
        return self._path(points, reason, narrowest, milliseconds, cells, self.pages - read)

    def update(self, low: Cell, clearance: np.ndarray) -> None:
        """Sets cells of the grid anew; see `WayGrid.write`. The next path heeds them."""
        self.grid.write(low, clearance)

    def update_blocks(self, coordinates: np.ndarray) -> None:
        """Takes over blocks of the distance field that the map is made of and that was updated.

        Args:
            coordinates: int32 [n, 3], of the blocks that changed; those that are gone may be among them.

        Raises:
            InputError: the map is made of something else.
        """
        if not isinstance(self.map.pages, FieldCells):
            raise InputError(f"{self.map.name}: expected a map of a distance field in space")
        for low, clearance in self.map.pages.of_blocks(np.asarray(coordinates)):
            self.grid.write(low, self._now(low, clearance))

    def add_obstacles(self, points: np.ndarray) -> None:
        """Puts obstacles into the map: clearances around fall to the distance from the cells that they are in.

        Args:
            points: [N, 3], metres in the map's frame, in or on them, no farther apart than cells. Robots that drive
                meet them whatever their height.
        """
        places = self.map.to_grid(points)
        if not len(places) or not np.isfinite(places).all():
            raise InputError(f"points: expected finite points [N, 3], found an array of shape {np.shape(points)}")
        places[:, self.map.dimensions :] = 0
        self._obstacles.append(places)
        reach = self._reach_cells * self.map.cell
        low, high = self.grid.cells_of(np.array([places.min(0) - reach, places.max(0) + reach]))
        size = high - low + 1
        shape = tuple(size[: self.map.dimensions][::-1].tolist())
        first = (int(low[0]), int(low[1]), int(low[2]))
        self.grid.write(first, self._with_obstacle(first, self.grid.read(first, shape), places), lower=True)

    # --- parts -------------------------------------------------------------------------------------------------------

    def _with_obstacle(self, low: Cell, clearance: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Clearances [Z, Y, X] or [Y, X] no larger than the distances from the cells of places [N, 3]."""
        n, reach = self.map.dimensions, self._reach_cells
        at = (self.grid.cells_of(places) - low + reach)[:, :n][:, ::-1]
        size = np.array(clearance.shape) + 2 * reach
        at = at[((at >= 0) & (at < size)).all(axis=1)]
        if not len(at):
            return clearance
        occupied = np.zeros(size, bool)
        occupied[tuple(at.T)] = True
        distance = cell_distances(occupied, self.map.cell, reach, self._context)[(slice(reach, -reach),) * n]
        return np.where(distance < clearance, distance, clearance)

    def _read_page(self, page: Cell) -> None:
        began = time.perf_counter()
        self.map.pages.prepare(self._towards_goal(page))
        for low, clearance in self.map.pages.read(page):
            self.grid.write(low, self._now(low, clearance), lower=True)
        self.grid.finish_page(page)
        self.pages += 1
        self._reading += time.perf_counter() - began

    def _towards_goal(self, page: Cell) -> list[Cell]:
        """The pages after one on the straight line to the goal that are not there yet, next first."""
        if not self.grid.page:
            return []
        edge, n = self.grid.page_cells * self.map.cell, self.map.dimensions
        here = (np.array(page) + 0.5) * edge
        here[n:] = 0
        far = float(np.linalg.norm(self._goal - here)) / edge
        found: list[Cell] = []
        for step in range(1, min(int(np.ceil(far)), PlannerTuning.pages_ahead) + 1):
            place = here + (self._goal - here) * min(1.0, step / max(far, 1e-9))
            x, y, z = (int(v) for v in self.grid.cells_of(place[None])[0] // self.grid.page_cells)
            if (x, y, z) != page and not self.grid.is_finished((x, y, z)) and (x, y, z) not in found:
                found.append((x, y, z))
        return found

    def _now(self, low: Cell, clearance: np.ndarray) -> np.ndarray:
        """Clearances of a page with the obstacles that came since the map was made."""
        for places in self._obstacles:
            clearance = self._with_obstacle(low, clearance, places)
        return clearance

    def _search(self, ends: np.ndarray) -> tuple[np.ndarray | None, int, np.ndarray]:
        """A path between places [2, 3] of the grid, how many cells were looked at for it, and how far the search came.
        Smoothing makes no path longer than the way over cells that it is made of, so the weight bounds its length."""
        s, spacing = self.settings, PlannerTuning.spacing_cells * self.map.cell
        way = self.grid.search(ends[0], ends[1], self.costs, self._read_page)
        points = way.points
        if points is not None:
            most = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
            points = self.grid.smooth(points, self.costs, spacing, s.push, s.passes, most)
        return points, way.expanded, way.reached

    def _path(
        self, points: np.ndarray | None, reason: str | None, narrowest: np.ndarray | None, milliseconds: float,
        cells: int, pages: int,
    ) -> PlannedPath:  # fmt: skip
        points = np.zeros((0, 3)) if points is None else points
        clearance = self.grid.clearance(points)
        least = float(self.grid.least_clearance(points).min()) if len(points) > 1 else float(clearance.min(initial=0))
        in_map = self.map.to_map(points)
        yaw = headings(transform_points(in_map, self.map.T_floor_map)) if self.map.dimensions == 2 else None
        return PlannedPath(
            in_map, clearance, yaw, self.costs.radius, least, reason,
            None if narrowest is None else self.map.to_map(narrowest)[0], milliseconds, cells, pages,
        )  # fmt: skip

    # --- why there is no path ----------------------------------------------------------------------------------------

    def _refusal(self, what: str, place: np.ndarray) -> str | None:
        """Why a place is no start or goal; None: it is one."""
        self._read_around(place, self.map.cell)
        clearance = float(self.grid.clearance(place)[0])
        if clearance >= self.costs.radius:
            return None
        n = self.map.dimensions
        cell = self.grid.cells_of(place[None])[0]
        own = float(self.grid.read((int(cell[0]), int(cell[1]), int(cell[2])), (1,) * n).reshape(()))
        if np.isnan(own):
            said = "lies in unknown space, or outside the map"
        elif np.isnan(clearance):
            said = "lies beside unknown space"
        elif clearance < PlannerTuning.touching:
            said = "lies in an obstacle"
        else:
            said = f"is {clearance:.2f} m from an obstacle, {self.costs.radius:.2f} m asked"
        return f"the {what} {said}{self._nearest_fit(place)}"

    def _read_around(self, place: np.ndarray, reach: float) -> None:
        """Reads the pages that the cells around a place are on."""
        self.read_box(place - reach, place + reach)

    def read_box(self, low: np.ndarray, high: np.ndarray) -> None:
        """Reads the pages of the map that a box [3], [3] (metres, in the grid's frame) touches."""
        if not self.grid.page:
            return
        low, high = self.grid.cells_of(np.array([low, high])) // self.grid.page_cells
        for step in np.ndindex(*(high - low + 1)):
            x, y, z = (int(v) for v in low + step)
            if not self.grid.is_finished((x, y, z)):
                self._read_page((x, y, z))

    def _nearest_fit(self, place: np.ndarray) -> str:
        """Where near a place the robot fits, in words."""
        n = self.map.dimensions
        reach = min(int(PlannerTuning.near_m / self.map.cell), PlannerTuning.near_cells[n])
        first = self.grid.cells_of(place[None])[0]
        first[:n] -= reach
        self._read_around(place, PlannerTuning.near_m)
        around = self.grid.read((int(first[0]), int(first[1]), int(first[2])), (2 * reach + 1,) * n)
        fits = np.argwhere(around >= self.costs.radius)[:, ::-1]
        if not len(fits):
            return ""
        centres = np.zeros((len(fits), 3))
        centres[:, :n] = (fits + first[:n] + 0.5) * self.map.cell
        far = np.linalg.norm(centres - place, axis=1)
        return f"; the nearest place that fits is {self._words(centres[far.argmin()])}, {far.min():.2f} m away"

    def _words(self, place: np.ndarray) -> str:
        """A place [3] of the grid, as people are told."""
        there = transform_points(self.map.to_map(place), self._T_told_map)[0]
        return f"({', '.join(f'{v:.2f}' for v in there)})"

    def _explain(self, ends: np.ndarray, reached: np.ndarray) -> tuple[str, np.ndarray | None]:
        """Why there is no way between places that fit, and where the widest one is narrowest."""
        widest = self.grid.search(ends[0], ends[1], WayCosts(PlannerTuning.touching, 0.0, 0.0), self._read_page, True)
        if widest.points is None:
            hint = "" if self.settings.unknown else ", or space that nobody has seen,"
            said = f"{_NO_WAY}: obstacles{hint} separate start and goal"
            return f"{said}; from the start {self._words(reached)} can be reached", None
        least = self.grid.least_clearance(widest.points)
        where = widest.points[1:][int(np.argmin(least))]
        wide = f"{float(least.min()):.2f} m clearance at {self._words(where)}"
        return f"{_NO_WAY}: the widest one has {wide}, {self.costs.radius:.2f} m asked", where


def headings(points: np.ndarray) -> np.ndarray:
    """Where a robot on a path [N, 3] looks, radians from the x axis, float64 [N]; at the end as on the last piece."""
    steps = np.diff(points[:, :2], axis=0)
    moving = np.linalg.norm(steps, axis=1) > 0
    if not moving.any():
        return np.zeros(len(points))
    angles = np.arctan2(steps[moving, 1], steps[moving, 0])
    rows = np.clip(np.cumsum(moving) - moving, 0, len(angles) - 1)
    return angles[np.append(rows, len(angles) - 1)]


def _place(what: str, place: np.ndarray) -> np.ndarray:
    point = np.asarray(place, np.float64)
    if point.shape != (3,) or not (np.abs(point) < 1e7).all():
        raise InputError(f"{what}: expected three finite numbers of metres, found {place}")
    return point
