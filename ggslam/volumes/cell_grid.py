# SPDX-License-Identifier: Apache-2.0
"""Square cells on an oriented plane. Arrays are [H, W] with row 0 at the top, where y is largest, as in pictures;
column 0 is where x is smallest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ggslam.errors import InputError
from ggslam.system.tuning import Tuning


class CellGridTuning(Tuning):
    """Limits of a grid."""

    max_cells = 50_000_000
    """Most cells."""


@dataclass(frozen=True)
class SlicePlane:
    """A rectangle in space.

    Attributes:
        origin: [3], metres, where the plane's coordinates are (0, 0).
        x_axis, y_axis: [3], orthogonal unit vectors.
        low, high: (x, y) of the rectangle's corners on the plane, metres.
    """

    origin: np.ndarray
    x_axis: np.ndarray
    y_axis: np.ndarray
    low: tuple[float, float]
    high: tuple[float, float]

    @property
    def normal(self) -> np.ndarray:
        """Unit vector; seen from its side, y is to the left of x."""
        return np.cross(self.x_axis, self.y_axis)

    def coordinates(self, points: np.ndarray) -> np.ndarray:
        """x, y and height above the plane, [N, 3], of points [N, 3] in space; metres."""
        relative = points - self.origin
        # einsum, for BLAS is slow with three columns
        return np.einsum("ni,ai->na", relative, np.stack([self.x_axis, self.y_axis, self.normal]))


@dataclass(frozen=True)
class GridWindow:
    """Some rows and columns of a grid, which are next to each other.

    Attributes:
        first_row, first_column: of the grid.
        shape: rows and columns (h, w); zero where nothing of the grid lies in it.
    """

    first_row: int
    first_column: int
    shape: tuple[int, int]

    @property
    def slices(self) -> tuple[slice, slice]:
        """Of arrays of the grid, [H, W]."""
        rows, columns = self.shape
        return (slice(self.first_row, self.first_row + rows), slice(self.first_column, self.first_column + columns))


@dataclass(frozen=True)
class CellGrid:
    """The cells of a rectangle.

    Attributes:
        plane: its rectangle is that of the cells.
        resolution: edge of a cell, metres.
        shape: rows and columns (H, W).
    """

    plane: SlicePlane
    resolution: float
    shape: tuple[int, int]

    @staticmethod
    def over(plane: SlicePlane, resolution: float) -> CellGrid:
        """The cells that cover a rectangle; it grows to the right and up to a whole number of them.

        Raises:
            InputError: a resolution that is not positive, or more than 50 million cells.
        """
        if not resolution > 0:
            raise InputError(f"expected a positive resolution, found {resolution}")
        width, height = (max(1, int(np.ceil((plane.high[a] - plane.low[a]) / resolution - 1e-6))) for a in (0, 1))
        if width * height > CellGridTuning.max_cells:
            raise InputError(f"resolution: {width} x {height} cells are more than {CellGridTuning.max_cells}")
        top_right = (plane.low[0] + width * resolution, plane.low[1] + height * resolution)
        return CellGrid(replace(plane, high=top_right), resolution, (height, width))

    @property
    def whole(self) -> GridWindow:
        """All rows and columns."""
        return GridWindow(0, 0, self.shape)

    def window(self, low: np.ndarray, high: np.ndarray) -> GridWindow:
        """The cells that have a part between the corners `low` and `high` (x, y) on the plane, metres."""
        ends = [np.floor((np.asarray(corner) - self.plane.low) / self.resolution).astype(int) for corner in (low, high)]
        top, bottom = (int(self.shape[0] - 1 - end[1]) for end in (ends[1], ends[0]))
        first_row, first_column = max(0, top), max(0, int(ends[0][0]))
        rows = min(self.shape[0] - 1, bottom) + 1 - first_row
        columns = min(self.shape[1] - 1, int(ends[1][0])) + 1 - first_column
        return GridWindow(first_row, first_column, (max(0, rows), max(0, columns)))

    def centres(self, window: GridWindow | None = None) -> np.ndarray:
        """Where the cells' centres are on the plane, (x, y) in metres, float64 [H, W, 2]; of a window, if one is given:
        the same, bit for bit."""
        of = window or self.whole
        rows, columns = of.first_row + np.arange(of.shape[0]), of.first_column + np.arange(of.shape[1])
        return np.stack(np.broadcast_arrays(*self._centres(rows[:, None], columns)), -1)

    def centres_of(self, cells: np.ndarray) -> np.ndarray:
        """The centres of some cells, bool [H, W], on the plane, float64 [N, 2]."""
        return np.stack(self._centres(*np.nonzero(cells)), -1)

    def _centres(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = self.plane.low[0] + (columns + 0.5) * self.resolution
        return x, self.plane.low[1] + (self.shape[0] - 1 - rows + 0.5) * self.resolution

    def places(self, window: GridWindow | None = None) -> np.ndarray:
        """The same as `centres` in space, float64 [H, W, 3]."""
        x, y = np.moveaxis(self.centres(window), -1, 0)
        # Not as a product of matrices, whose roundings depend on how many rows they have.
        return np.asarray(self.plane.origin + (x[..., None] * self.plane.x_axis + y[..., None] * self.plane.y_axis))

    def cells_of(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows and columns of the cells that places (x, y) [N, 2] on the plane lie in, int64 [N] each, and whether they
        lie in the grid, bool [N]; rows and columns of others lie outside of it."""
        column, from_bottom = np.floor((np.asarray(places)[:, :2] - self.plane.low) / self.resolution).astype(int).T
        inside = (column >= 0) & (column < self.shape[1]) & (from_bottom >= 0) & (from_bottom < self.shape[0])
        return self.shape[0] - 1 - from_bottom, column, inside

    def outline(self, cells: np.ndarray) -> np.ndarray:
        """Places [N, 2] on the plane along the edges of cells, bool [H, W], that have a neighbour which is none of
        them: corners and middles of edges."""
        around = np.pad(cells, 1, constant_values=False)
        inner = np.logical_and.reduce([around[r : r + self.shape[0], c : c + self.shape[1]] for r in range(3)
                                       for c in range(3)])  # fmt: skip
        steps = (np.stack(np.meshgrid(*2 * [(-0.5, 0.0, 0.5)]), -1) * self.resolution).reshape(-1, 2)
        return (self.centres_of(cells & ~inner)[:, None] + steps).reshape(-1, 2)

    def mark(
        self, places: np.ndarray, reach: Sequence[float] | np.ndarray = (0.0, 0.0), window: GridWindow | None = None
    ) -> np.ndarray:
        """Cells, bool [H, W], of the grid or a window, that rectangles around places [N, 2] on the plane overlap; they
        reach so far from these along x and y, metres."""
        of = window or self.whole
        marked = np.zeros(of.shape, bool)
        ends = [np.floor((places[:, :2] + side * np.array(reach) - self.plane.low) / self.resolution).astype(int)
                for side in (-1, 1)]  # fmt: skip
        steps = (ends[1] - ends[0]).max(axis=0, initial=0)
        for step in np.ndindex(*(steps + 1)):
            column, from_bottom = np.minimum(ends[0] + step, ends[1]).T
            row, column = self.shape[0] - 1 - from_bottom - of.first_row, column - of.first_column
            inside = (column >= 0) & (column < of.shape[1]) & (row >= 0) & (row < of.shape[0])
            marked[row[inside], column[inside]] = True
        return marked
