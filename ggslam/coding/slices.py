# SPDX-License-Identifier: Apache-2.0
"""Cutting a cloud into slices that are coded alone (equations 7 to 9 of the slice-parallel G-PCC encoder for embedded
systems: equal numbers of points, or equal intervals, along the longest axis). Points of one voxel stay together."""

from __future__ import annotations

import numpy as np

from ggslam.coding.grid_points import GridPoints
from ggslam.coding.quantization import Quantization
from ggslam.coding.settings import CodecSettings


def assign_slices(points: np.ndarray, quantization: Quantization, settings: CodecSettings) -> np.ndarray | None:
    """Slice number, from 0 without gaps, of each of the points [N, 3]; None: all in one slice.

    No slice has more than `settings.max_points` points unless a single voxel has.
    """
    wanted = max(settings.slices, -(-len(points) // settings.max_points))
    if wanted == 1:
        return None
    grid = quantization.of(points)
    if settings.split == "cube":
        number = _by_cube(grid, wanted)
    elif settings.split == "interval":
        number = _by_interval(grid, wanted)
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


def _longest_first(grid: GridPoints) -> list[int]:
    return sorted(range(3), key=lambda axis: -grid.size[axis])


def _by_interval(grid: GridPoints, wanted: int) -> np.ndarray:
    axis = _longest_first(grid)[0]
    size = grid.size[axis]
    numbers, _ = grid.number_planes(axis, np.arange(size) * wanted // size, np.zeros(size, int), np.zeros(size, bool))
    return numbers


def _by_count(grid: GridPoints, rows: np.ndarray | None, wanted: int) -> np.ndarray:
    """Numbers in [0, wanted) of `rows` (None: all): by the longest axis, the points of a plane that is cut by the other
    two."""
    axes = _longest_first(grid)
    counts = grid.plane_counts(axes[0], rows)
    totals = np.cumsum(counts, dtype=np.int64)
    ranks = totals[-1] * np.arange(1, wanted) // wanted
    planes = np.searchsorted(totals, ranks, side="right")  # the plane that holds each cut
    cut = np.zeros(len(totals), bool)
    cut[planes] = True
    of_plane = np.searchsorted(planes, np.arange(len(totals)), side="left")
    number, inside = grid.number_planes(axes[0], of_plane, counts, cut, rows)
    absolute = inside if rows is None else rows[inside]
    coordinate = grid.coordinates(axes[0], absolute)
    for plane in np.flatnonzero(cut):
        own = coordinate == plane
        keys = grid.coordinates(axes[1], absolute[own]).astype(np.int64) << 21
        keys |= grid.coordinates(axes[2], absolute[own])
        local = ranks[planes == plane] - (totals[plane] - counts[plane])
        cuts = np.partition(keys, local)[local]
        number[inside[own]] += np.searchsorted(cuts, keys, side="right").astype(np.uint16)
    return number


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
