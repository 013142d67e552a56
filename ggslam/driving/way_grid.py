# SPDX-License-Identifier: Apache-2.0
"""Cells that know how far the nearest obstacle is, and searches on them; their memory belongs to the compiled core."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from ggslam.abi.core import SearchState, SmoothingSettings, WayQuery, WayStats
from ggslam.errors import InputError
from ggslam.native.loader import NativeContext, load_library
from ggslam.system.tuning import Tuning

BLOCK: Final = {2: 32, 3: 8}
"""Edge of the compiled core's blocks in cells, by the number of dimensions."""
Cell = tuple[int, int, int]
"""Whole coordinates of a cell, or of a page of cells, along x, y, z; z is 0 in two dimensions."""


class WaySearchTuning(Tuning):
    """How a search is done in parts."""

    cells_at_once = 200_000
    """Cells that the core looks at before Python is asked whether somebody wants to stop."""


@dataclass(frozen=True)
class WayCosts:
    """What a way costs.

    Attributes:
        radius: least clearance, metres.
        margin: clearance beyond the radius from which on a metre costs a metre, metres.
        weight: what a metre costs more at the radius; between radius and margin it falls with the square.
    """

    radius: float
    margin: float
    weight: float


@dataclass(frozen=True)
class FoundWay:
    """What a search found.

    Attributes:
        points: float64 [N, 3], metres in the grid's frame, from start to goal, cell by cell; None: there is no way.
        cost: metres, or the least clearance of the widest way.
        expanded: cells that were looked at.
        reached: [3], the cell that was reached nearest to the goal.
    """

    points: np.ndarray | None
    cost: float
    expanded: int
    reached: np.ndarray


class WayGrid:
    """A grid in two or three dimensions. One caller at a time.

    Args:
        dimensions: 2 or 3.
        cell: edge of a cell, metres; cell (0, 0, 0) has its lower corner at the grid's origin.
        page: edge of a page in blocks (of `BLOCK` cells); 0: all cells are written before a search.
    """

    def __init__(self, dimensions: int, cell: float, page: int = 0) -> None:
        self._handle: int | None = None
        self.dimensions, self.cell, self.page = dimensions, float(cell), page
        self._finished: set[Cell] = set()
        self._library = load_library()
        self._handle = self._library.ggslam_way_grid_create(dimensions, self.cell, page)

    def __del__(self) -> None:
        if getattr(self, "_handle", None) is not None:
            self._library.ggslam_way_grid_destroy(self._handle)

    @property
    def memory_bytes(self) -> int:
        """Taken by cells and by what the searches remember."""
        return int(self._library.ggslam_way_grid_bytes(self._handle))

    @property
    def page_cells(self) -> int:
        """Edge of a page in cells."""
        return self.page * BLOCK[self.dimensions]

    def write(self, low: Cell, clearance: np.ndarray, lower: bool = False) -> None:
        """Sets cells.

        Args:
            low: first cell.
            clearance: [Z, Y, X] (or [Y, X]), metres to the nearest obstacle; NaN: may not be entered.
            lower: no clearance that a search has met becomes larger. What was learned of the way to the last goal then
                serves the next search for it.
        """
        values = np.ascontiguousarray(clearance, np.float32)
        values = values[None] if values.ndim == 2 else values
        first, shape = _box(low, values)
        self._library.ggslam_way_grid_write(self._handle, first, shape, values.ctypes.data, int(lower))

    def read(self, low: Cell, shape: tuple[int, ...]) -> np.ndarray:
        """Clearances float32 of the cells from `low` on, of a shape [Z, Y, X] (or [Y, X]); NaN where none may be
        entered."""
        values = np.empty(shape if len(shape) == 3 else (1, *shape), np.float32)
        first, size = _box(low, values)
        self._library.ggslam_way_grid_read(self._handle, first, size, values.ctypes.data)
        return values.reshape(shape)

    def finish_page(self, page: Cell) -> None:
        """All cells of a page that may be entered were written."""
        self._finished.add(page)
        self._library.ggslam_way_grid_finish_page(self._handle, (ctypes.c_int32 * 3)(*page))

    def is_finished(self, page: Cell) -> bool:
        """Whether a page was read."""
        return page in self._finished

    def cells_of(self, points: np.ndarray) -> np.ndarray:
        """The cells that points [N, 3] (metres) lie in, int64 [N, 3]."""
        cells = np.floor(np.asarray(points, np.float64) / self.cell).astype(np.int64)
        cells[:, self.dimensions :] = 0
        return cells

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Interpolated clearance at points [N, 3], metres, float32 [N]; NaN beside cells that may not be entered."""
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        out = np.empty(len(points), np.float32)
        self._library.ggslam_way_grid_query(self._handle, len(points), points.ctypes.data, out.ctypes.data, None)
        return out

    def least_clearance(self, points: np.ndarray) -> np.ndarray:
        """Least interpolated clearance on each piece of a path through points [N, 3], metres, float32 [N - 1]: the
        minimum along the whole piece, not of samples."""
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        out = np.empty(max(0, len(points) - 1), np.float32)
        self._library.ggslam_way_grid_least(self._handle, len(points), points.ctypes.data, out.ctypes.data)
        return out

    def search(
        self, start: np.ndarray, goal: np.ndarray, costs: WayCosts, read_page: Callable[[Cell], None],
        widest: bool = False,
    ) -> FoundWay:  # fmt: skip
        """Looks for a way.

        Args:
            start, goal: [3], metres.
            costs: what it costs.
            read_page: writes and finishes a page that the search has come to.
            widest: the way with the largest least clearance is looked for, whatever its length; no cell with less
                clearance than the radius is entered.
        """
        places = ((ctypes.c_double * 3)(*map(float, p)) for p in (start, goal))
        numbers = (costs.radius, costs.margin, costs.weight)
        query, stats = WayQuery(*places, *numbers, int(widest)), WayStats()
        state = self._library.ggslam_way_begin(self._handle, ctypes.byref(query))
        while state in (SearchState.SEARCHING, SearchState.NEEDS_PAGES):
            if state == SearchState.NEEDS_PAGES:
                x, y, z = stats.wanted
                read_page((x, y, z))
            state = self._library.ggslam_way_search(self._handle, WaySearchTuning.cells_at_once, ctypes.byref(stats))
        points = None
        if state == SearchState.FOUND:
            points = np.empty((stats.points, 3))
            self._library.ggslam_way_points(self._handle, len(points), points.ctypes.data)
        return FoundWay(points, stats.cost, stats.expanded, np.array(stats.reached))

    def smooth(
        self, points: np.ndarray, costs: WayCosts, spacing: float, push: float, passes: int, most_length: float
    ) -> np.ndarray:
        """Pulls a path through points [N, 3] tight and smooths it.

        Args:
            points: of a search, metres.
            costs: of the search; no piece of the path gets nearer to an obstacle than their radius.
            spacing: between points of the result, metres.
            push: part of its missing margin that a point is pushed away from obstacles in a pass.
            passes: how often points move, at most; 0: the path is pulled tight only.
            most_length: the path does not get longer than this by being smoothed, metres.
        """
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        settings = SmoothingSettings(costs.radius, costs.margin, costs.weight, spacing, push, most_length, passes)
        n = self._library.ggslam_way_smooth(self._handle, len(points), points.ctypes.data, ctypes.byref(settings))
        out = np.empty((n, 3))
        self._library.ggslam_way_smooth_points(self._handle, n, out.ctypes.data)
        return out


def cell_distances(occupied: np.ndarray, cell: float, reach: int, context: NativeContext) -> np.ndarray:
    """Distances from the centres of cells to the nearest occupied cell, metres, float32.

    Args:
        occupied: bool [Z, Y, X] or [Y, X].
        cell: edge of a cell, metres.
        reach: cells; what is farther counts as this far.
        context: threads.
    """
    cells = np.ascontiguousarray(occupied, np.uint8)
    if cells.ndim not in (2, 3):
        raise InputError(f"occupied: expected 2 or 3 dimensions, found an array of shape {list(cells.shape)}")
    out = np.empty(cells.shape, np.float32)
    shape = (ctypes.c_int32 * 3)(*cells.shape[::-1], *([1] * (3 - cells.ndim)))
    load_library().ggslam_cell_distances(context.handle, shape, cells.ctypes.data, cell, reach, out.ctypes.data)
    return out


def _box(low: Cell, values: np.ndarray) -> tuple[ctypes.Array, ctypes.Array]:
    if values.ndim != 3 or len(low) != 3:
        raise InputError(f"clearance: expected 2 or 3 dimensions, found an array of shape {list(values.shape)}")
    return (ctypes.c_int32 * 3)(*map(int, low)), (ctypes.c_int32 * 3)(*values.shape[::-1])
