# SPDX-License-Identifier: Apache-2.0
"""Cutting a cloud into slices that are coded alone (equations 7 to 9 of the slice-parallel G-PCC encoder for embedded
systems: equal numbers of points, or equal intervals, along the longest axis). Points of one voxel stay together."""

from __future__ import annotations

import numpy as np

from ggslam.coding.quantization import Quantization
from ggslam.coding.settings import CodecSettings


def assign_slices(points: np.ndarray, quantization: Quantization, settings: CodecSettings) -> np.ndarray | None:
    """Slice number, from 0 without gaps, of each of the points [N, 3]; None: all in one slice.

    No slice has more than `settings.max_points` points unless a single voxel has.
    """
    count = len(points)
    wanted = max(settings.slices, -(-count // settings.max_points))
    if wanted == 1:
        return None
    cutter = _Cutter(points, quantization)
    if settings.split == "cube":
        number = cutter.by_cube(wanted)
    elif settings.split == "interval":
        number = cutter.by_interval(wanted)
    else:
        number = cutter.by_count(None, wanted)
    counts = np.bincount(number)
    if counts.max() > settings.max_points:
        number = _divide_large(cutter, number, counts, settings.max_points)
        counts = np.bincount(number)
    rank = np.cumsum(counts > 0) - 1
    if rank[-1] == 0:
        return None
    kind = np.min_scalar_type(rank[-1])
    return number.astype(kind) if (counts > 0).all() else rank.astype(kind)[number]


class _Cutter:
    """Computes grid coordinates of one axis at a time, so that the whole grid is never held."""

    def __init__(self, points: np.ndarray, quantization: Quantization) -> None:
        self._points = points
        self._quantization = quantization
        assert quantization.size is not None
        self._size = quantization.size
        self.axes = sorted(range(3), key=lambda axis: -self._size[axis])

    def coordinate(self, axis: int, rows: np.ndarray | None = None) -> np.ndarray:
        values = self._points[:, axis] if rows is None else self._points[rows, axis]
        return self._quantization.apply_along(axis, values)

    def by_interval(self, wanted: int) -> np.ndarray:
        axis = self.axes[0]
        return (self.coordinate(axis).astype(np.int64) * wanted // self._size[axis]).astype(np.int32)

    def by_count(self, rows: np.ndarray | None, wanted: int) -> np.ndarray:
        """Numbers in [0, wanted) of `rows` (None: all): by the longest axis, the points of a plane that is cut by the
        other two."""
        coordinate = self.coordinate(self.axes[0], rows)
        totals = np.cumsum(np.bincount(coordinate))
        ranks = len(coordinate) * np.arange(1, wanted) // wanted
        planes = np.searchsorted(totals, ranks, side="right")  # the plane that holds each cut
        number = np.searchsorted(planes, np.arange(len(totals)), side="left")
        number = number.astype(np.min_scalar_type(wanted - 1))[coordinate]
        for plane in np.unique(planes):
            inside = np.flatnonzero(coordinate == plane)
            before = int(totals[plane] - len(inside))
            local = ranks[planes == plane] - before
            before_row = self._cuts_before(inside if rows is None else rows[inside], local)
            number[inside] += before_row.astype(number.dtype)
        return number

    def _cuts_before(self, rows: np.ndarray, ranks: np.ndarray) -> np.ndarray:
        """How many of the cuts at `ranks`, of the rows ordered by the shorter axes, lie before each row."""
        key = self.coordinate(self.axes[1], rows).astype(np.int64)
        key = key << 21 | self.coordinate(self.axes[2], rows)
        cuts = np.sort(key)[ranks]
        return np.searchsorted(cuts, key, side="right")

    def by_cube(self, wanted: int) -> np.ndarray:
        """The largest cubes, with edges of a power of two, of which at least `wanted` are occupied."""
        coordinates = [self.coordinate(axis) for axis in range(3)]
        bits = max(self._size).bit_length()
        for edge in range(bits - 1, -1, -1):
            key = np.zeros(len(self._points), np.int64)
            for c in coordinates:
                key = key << 21 | c >> edge
            cubes, number = np.unique(key, return_inverse=True)
            if len(cubes) >= wanted or edge == 0 or len(cubes) > 4096:
                break
        return number.reshape(-1).astype(np.int32)


def _divide_large(cutter: _Cutter, number: np.ndarray, counts: np.ndarray, max_points: int) -> np.ndarray:
    number = number.astype(np.int32)
    for large in np.flatnonzero(counts > max_points):
        rows = np.flatnonzero(number == large)
        parts = cutter.by_count(rows, -(-len(rows) // max_points))
        number[rows] = np.where(parts == 0, large, number.max() + parts)
    return number
