# SPDX-License-Identifier: Apache-2.0
"""What a volume has between two heights above a grid's cells: of a map in memory, and of cells on disk, a few at a
time. Both give the same, bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from ggslam.system.tuning import Tuning
from ggslam.volumes.cell_field import AnyField, CellField
from ggslam.volumes.cell_grid import CellGrid
from ggslam.volumes.columns import seen_above
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.seen_surface import SeenSurface


class BandSourceTuning(Tuning):
    """How volumes are looked at."""

    most_layer_bytes = 256 << 20
    """Most memory for what was seen at the heights of a volume; of large maps each band looks again."""
    same_place = 1 / 16
    """Surface points above one another count as one if they are this share of a cell apart."""
    site_reach_voxels = 2.0
    """Distances that are computed to find surface points alone, in voxels: none of them is looked at."""


class BandSource(Protocol):
    """What there is between two heights, metres above the grid's plane."""

    def look(self, low: float, high: float) -> np.ndarray:
        """What the voxels are, together, as `seen_above` tells, uint8 [H, W]: layers a voxel apart, or the one at the
        middle."""

    def surface(self, low: float, high: float, on_floor: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cells that may have a measured point and those that have one, bool [H, W], see `SeenSurface`; and the surface
        points, float64 [N, 2] on the plane, metres, one for all in the same place."""


def band_source(field: AnyField, grid: CellGrid) -> BandSource:
    """That of a field in memory or on disk."""
    return _CellsOnDisk(field, grid) if isinstance(field, CellField) else _InMemory(field, grid)


class _InMemory:
    def __init__(self, field: DistanceField, grid: CellGrid) -> None:
        self._field, self._grid = field, grid
        self._surface = SeenSurface(field, grid.plane)
        self._layers: dict[int, np.ndarray] = {}

    def look(self, low: float, high: float) -> np.ndarray:
        spacing, grid = self._field.voxel, self._grid
        most = _most_layers(grid.shape)
        found = np.zeros(grid.shape, np.uint8)
        for start, count in _runs(low, high, spacing, most):
            if any(number not in self._layers for number in range(start, start + count)):
                new = seen_above(self._field.tsdf, grid, start * spacing, spacing, count)
                if len(self._layers) + count > most:
                    self._layers = {}
                self._layers |= {start + k: layer for k, layer in enumerate(new)}
            for number in range(start, start + count):
                found |= self._layers[number]
        return found

    def surface(self, low: float, high: float, on_floor: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        near = self._surface.near_points(self._grid, low, high, on_floor)
        measured = self._surface.with_points(self._grid, low, high)
        return near, measured, _thin_out(self._surface.sites(low, high), self._grid)


class _CellsOnDisk:
    def __init__(self, field: CellField, grid: CellGrid) -> None:
        self._field, self._grid = field, grid

    def look(self, low: float, high: float) -> np.ndarray:
        spacing, grid = self._field.voxel, self._grid
        found = np.zeros(grid.shape, np.uint8)
        for part in self._field.parts(grid.plane, low, high):
            window = part.window(grid)
            for start, count in _runs(low, high, spacing, _most_layers(window.shape)):
                layers = seen_above(part.tsdf, grid, start * spacing, spacing, count, window)
                found[window.slices] |= np.bitwise_or.reduce(layers, axis=0)
        return found

    def surface(self, low: float, high: float, on_floor: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        grid, sites = self._grid, [np.zeros((0, 2))]
        near, measured = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)
        reach = BandSourceTuning.site_reach_voxels * self._field.voxel
        for part in self._field.parts(grid.plane, low, high, reach):
            window, surface = part.window(grid), SeenSurface(part.field, grid.plane, part.owns)
            near[window.slices] |= surface.near_points(grid, low, high, on_floor, window)
            measured[window.slices] |= surface.with_points(grid, low, high, window)
            sites.append(_thin_out(surface.sites(low, high), grid))
        return near, measured, _thin_out(np.concatenate(sites), grid)


def _most_layers(shape: tuple[int, int]) -> int:
    return max(1, BandSourceTuning.most_layer_bytes // max(1, shape[0] * shape[1]))


def _runs(low: float, high: float, spacing: float, most: int) -> Iterator[tuple[int, int]]:
    """First layer, counted from the plane, and number of layers of the runs that a band is looked at in."""
    first, last = int(np.ceil(low / spacing - 1e-6)), int(np.floor(high / spacing + 1e-6))
    if first > last:
        first = last = int(np.rint((low + high) / 2 / spacing))
    for start in range(first, last + 1, most):
        yield start, min(most, last + 1 - start)


def _thin_out(points: np.ndarray, grid: CellGrid) -> np.ndarray:
    """One for all points [N, 2] that are in the same place: their least x and y, whatever order they come in, all at
    once or some after the others."""
    if not len(points):
        return points
    at = np.floor((points - grid.plane.low) / (grid.resolution * BandSourceTuning.same_place)).astype(np.int64)
    key = (at[:, 0] << 32) + at[:, 1]
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=key[order[0]] - 1))
    by_place = points[order]
    return np.minimum.reduceat(by_place, first)
