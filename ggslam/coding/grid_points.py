# SPDX-License-Identifier: Apache-2.0
"""Points on the codec's grid, by the compiled core (ggslam/native/src/codec/gpcc_grid_api.cpp)."""

from __future__ import annotations

import numpy as np

from ggslam.abi.core import Grid, Points
from ggslam.native.loader import load_library

_KINDS = {np.dtype(kind): number for number, kind in enumerate((np.int32, np.int64, np.float32, np.float64))}


class GridPoints:
    """Points [N, 3] and the grid clip(floor(scale p + rounding) - origin, 0, size - 1) they are seen on.

    `exact`: coordinates are integers that stand for themselves. Methods take `rows`, int64 [M], to mean only those;
    None: all points. Only what is asked for is computed: the grid positions of all need not be held.
    """

    def __init__(
        self,
        points: np.ndarray,
        scale: float,
        rounding: float,
        origin: tuple[int, int, int],
        size: tuple[int, int, int],
        exact: bool,
    ) -> None:
        if points.dtype not in _KINDS:
            points = points.astype(np.int64 if np.issubdtype(points.dtype, np.integer) else np.float64)
        self._points = np.ascontiguousarray(points)
        self._grid = Grid(scale, rounding, origin, tuple(o + s - 1 for o, s in zip(origin, size, strict=True)), exact)
        self._scale, self._origin, self._exact, self.size = scale, origin, exact, size

    def __len__(self) -> int:
        return len(self._points)

    def positions(self, rows: np.ndarray | None = None) -> np.ndarray:
        """Grid positions int32 [M, 3]."""
        chosen = self._select(rows)
        out = np.empty((chosen.count, 3), np.int32)
        load_library().ggslam_gpcc_on_grid(chosen, self._grid, out.ctypes.data)
        return out

    def places(self, positions: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Where points lie before they are rounded to their grid positions [M, 3], voxels float64 [M, 3]; those that
        were moved into the box lie at their positions."""
        if self._exact:
            return positions.astype(np.float64)
        points = self._points if rows is None else self._points[rows]
        exact = points.astype(np.float64) * self._scale - np.array(self._origin, np.float64)
        return np.where(np.abs(exact - positions) < 0.51, exact, positions)

    def coordinates(self, axis: int, rows: np.ndarray | None = None) -> np.ndarray:
        """Grid coordinates int32 [M] along an axis."""
        chosen = self._select(rows)
        out = np.empty(chosen.count, np.int32)
        load_library().ggslam_gpcc_along_axis(chosen, self._grid, axis, out.ctypes.data)
        return out

    def sample_cubes(self, cube_bits: int, one_in: int) -> np.ndarray:
        """Codes uint64 [M] of 21 bits a coordinate, x first, of the points in one of so many (a power of two) cubes of
        an edge of 2^cube_bits voxels. Whole slabs across x are passed over, unless there are few."""
        codes, cubes = np.empty(len(self), np.uint64), (self.size[0] - 1 >> cube_bits) + 1
        slabs = min(one_in, 8, 1 << max(0, (cubes // 8).bit_length() - 1))
        count = load_library().ggslam_gpcc_sample_cubes(
            self._select(None), self._grid, cube_bits, slabs - 1, one_in // slabs - 1, codes.ctypes.data
        )
        return codes[:count].copy()

    def plane_counts(self, axis: int, rows: np.ndarray | None = None) -> np.ndarray:
        """Number of points in each plane across an axis, uint32 [size of the axis]."""
        counts = np.zeros(self.size[axis], np.uint32)
        load_library().ggslam_gpcc_plane_counts(self._select(rows), self._grid, axis, counts.ctypes.data)
        return counts

    def number_planes(
        self,
        axis: int,
        number_of_plane: np.ndarray,
        counts: np.ndarray,
        cut: np.ndarray,
        rows: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gives points the number of their plane.

        Args:
            number_of_plane: uint16 [size of the axis].
            counts: from `plane_counts`.
            cut: bool [size of the axis], planes whose points are to be listed.

        Returns:
            Numbers uint16 [M], and the indices int64 among the M of points in the planes `cut`.
        """
        chosen = self._select(rows)
        numbers, inside = np.empty(chosen.count, np.uint16), np.empty(int(counts[cut].sum()), np.int64)
        number_of_plane, cut = np.ascontiguousarray(number_of_plane, np.uint16), np.ascontiguousarray(cut, bool)
        load_library().ggslam_gpcc_number_planes(
            chosen, self._grid, axis, number_of_plane.ctypes.data, cut.ctypes.data, numbers.ctypes.data,
            inside.ctypes.data,
        )  # fmt: skip
        return numbers, inside

    def _select(self, rows: np.ndarray | None) -> Points:
        kind, data = _KINDS[self._points.dtype], self._points.ctypes.data
        if rows is None:
            return Points(data, None, len(self._points), kind)
        if rows.dtype != np.int64 or not rows.flags.c_contiguous:
            raise ValueError(f"expected contiguous int64 rows, found {rows.dtype}")
        return Points(data, rows.ctypes.data, len(rows), kind)
