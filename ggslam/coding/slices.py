# SPDX-License-Identifier: Apache-2.0
"""Cutting a cloud into slices that are coded alone (equations 7 to 9 of the slice-parallel G-PCC encoder for embedded
systems: equal numbers of points, or equal intervals, along the longest axis). Points of one voxel stay together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.coding.grid_points import GridPoints
from ggslam.coding.quantization import Quantization
from ggslam.coding.settings import CodecSettings

Points = tuple[GridPoints, np.ndarray | None]
"""Points on the grid, and which of them (int64 [M]; None: all)."""


def slices_wanted(count: int, settings: CodecSettings) -> int:
    """Slices that so many points are cut into at least."""
    return max(settings.slices, -(-count // settings.max_points))


def assign_slices(points: np.ndarray, quantization: Quantization, settings: CodecSettings) -> np.ndarray | None:
    """Slice number, from 0 without gaps, of each of the points [N, 3]; None: all in one slice.

    No slice has more than `settings.max_points` points unless a single voxel has.
    """
    wanted = slices_wanted(len(points), settings)
    if wanted == 1:
        return None
    grid = quantization.of(points)
    if settings.split == "cube":
        number = _by_cube(grid, wanted)
    elif settings.split == "interval":
        number = PlaneCuts.by_interval(grid.size, wanted).numbers(grid)
    else:
        number = _by_count(grid, None, wanted)
    counts = np.bincount(number)
    if counts.max() > settings.max_points:
        number = _divide_large(grid, number, counts, settings.max_points)
        counts = np.bincount(number)
    if (counts > 0).all():
        return number if len(counts) > 1 else None
    rank = np.cumsum(counts > 0) - 1
    return rank.astype(np.min_scalar_type(rank[-1]))[number] if rank[-1] else None


def _longest_first(size: Sequence[int]) -> list[int]:
    return sorted(range(3), key=lambda axis: -size[axis])


@dataclass(frozen=True)
class PlaneCuts:
    """Slices along an axis: planes across it have a number each, or are cut by the other two axes.

    Attributes:
        axes: that axis, and the other two.
        of_plane: slice of each plane; of one that is cut, of its first points.
        cuts: by plane that is cut, the least keys (by the second axis, then the third) of its further slices, rising.
    """

    axes: Sequence[int]
    of_plane: np.ndarray
    cuts: Mapping[int, np.ndarray]

    @staticmethod
    def by_interval(size: Sequence[int], wanted: int) -> PlaneCuts:
        """Equal intervals of the longest axis of a grid of that size."""
        axes = _longest_first(size)
        longest = size[axes[0]]
        return PlaneCuts(axes, np.arange(longest) * wanted // longest, {})

    @staticmethod
    def by_count(blocks: Callable[[], Iterable[Points]], size: Sequence[int], wanted: int) -> PlaneCuts:
        """Equal numbers of points along the longest axis.

        Args:
            blocks: the points, each time it is called.
            size: of their grid.
            wanted: slices.
        """
        axes = _longest_first(size)
        counts = np.zeros(size[axes[0]], np.uint32)
        for grid, rows in blocks():
            counts += grid.plane_counts(axes[0], rows)
        totals = np.cumsum(counts, dtype=np.int64)
        ranks = totals[-1] * np.arange(1, wanted) // wanted
        planes = np.searchsorted(totals, ranks, side="right")  # the plane that holds each cut
        of_plane = np.searchsorted(planes, np.arange(len(totals)), side="left")
        through = PlaneCuts(axes, of_plane, dict.fromkeys(planes.tolist(), np.empty(0, np.int64)))
        found: dict[int, list[np.ndarray]] = {plane: [] for plane in through.cuts}
        for grid, rows in blocks():
            for plane, _, keys in through._inside(grid, rows)[1]:
                found[plane].append(keys)
        cuts = {}
        for plane, parts in found.items():
            local = ranks[planes == plane] - (totals[plane] - counts[plane])
            cuts[plane] = np.partition(np.concatenate(parts), local)[local]
        return PlaneCuts(axes, of_plane, cuts)

    def numbers(self, grid: GridPoints, rows: np.ndarray | None = None) -> np.ndarray:
        """Slice of each of the points `rows` (int64 [M]; None: all), uint16 [M]."""
        numbers, inside = self._inside(grid, rows)
        for plane, place, keys in inside:
            numbers[place] += np.searchsorted(self.cuts[plane], keys, side="right").astype(np.uint16)
        return numbers

    def _inside(
        self, grid: GridPoints, rows: np.ndarray | None
    ) -> tuple[np.ndarray, Iterator[tuple[int, np.ndarray, np.ndarray]]]:
        """Slices uint16 [M] of the points by their planes alone; of each plane that is cut, places and keys of its
        points."""
        cut = np.zeros(len(self.of_plane), bool)
        cut[list(self.cuts)] = True
        counts = grid.plane_counts(self.axes[0], rows) if self.cuts else np.zeros(len(cut), np.uint32)
        numbers, inside = grid.number_planes(self.axes[0], self.of_plane, counts, cut, rows)
        absolute = inside if rows is None else rows[inside]
        coordinate = grid.coordinates(self.axes[0], absolute)

        def planes() -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
            for plane in np.flatnonzero(cut & (counts > 0)).tolist():
                own = coordinate == plane
                keys = grid.coordinates(self.axes[1], absolute[own]).astype(np.int64) << 21
                keys |= grid.coordinates(self.axes[2], absolute[own])
                yield plane, inside[own], keys

        return numbers, planes()


def _by_count(grid: GridPoints, rows: np.ndarray | None, wanted: int) -> np.ndarray:
    """Numbers in [0, wanted) of `rows` (None: all)."""
    return PlaneCuts.by_count(lambda: [(grid, rows)], grid.size, wanted).numbers(grid, rows)


def _by_cube(grid: GridPoints, wanted: int) -> np.ndarray:
    """The largest cubes, with edges of a power of two, of which at least `wanted` are occupied."""
    coordinates = [grid.coordinates(axis) for axis in range(3)]
    for edge in range(max(grid.size).bit_length() - 1, -1, -1):
        key = np.zeros(len(grid), np.int64)
        for c in coordinates:
            key = key << 21 | c >> edge
        cubes, number = np.unique(key, return_inverse=True)
        if len(cubes) >= wanted or edge == 0 or len(cubes) > 4096:
            break
    return number.reshape(-1).astype(np.int32)


def _divide_large(grid: GridPoints, number: np.ndarray, counts: np.ndarray, max_points: int) -> np.ndarray:
    number = number.astype(np.int32)
    for large in np.flatnonzero(counts > max_points):
        rows = np.flatnonzero(number == large)
        parts = _by_count(grid, rows, -(-len(rows) // max_points)).astype(np.int32)
        number[rows] = np.where(parts == 0, large, number.max() + parts)
    return number
