# SPDX-License-Identifier: Apache-2.0
"""The region that a map in memory covers. Points of a scan beyond it say nothing about the pose of the scan.

Cells of a cloud hold what lies in them. Cells that a sensor recorded hold what it saw from near their centres, up to
its range, so that they reach beyond their edges and overlap.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from ggslam.submaps.cell_keys import CellKey, Grid
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.tuning import Tuning


class CoverageTuning(Tuning):
    """What a map in memory can contain."""

    min_beyond = 1.01
    """Distance of a cell's points from its centre, relative to its corners', from which a sensor recorded the cell."""


class Coverage(Protocol):
    """A region of the world."""

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Whether world points [n, 3] lie in it, bool [n]."""


@dataclass(frozen=True)
class Everywhere:
    """The whole world."""

    def covers(self, points: np.ndarray) -> np.ndarray:
        """See `Coverage`."""
        return np.ones(len(points), bool)


@dataclass(frozen=True)
class CutCells:
    """The cells within reach of a place, those without content included, as far as the map goes.

    Attributes:
        grid: of the cells.
        low, high: corners [3] of the box around all cells with content; infinite along axes without a grid.
        position: the place [3]; None: all cells.
        radius: metres from it to the centres.
    """

    grid: Grid
    low: np.ndarray
    high: np.ndarray
    position: np.ndarray | None = None
    radius: float = np.inf

    def covers(self, points: np.ndarray) -> np.ndarray:
        """See `Coverage`."""
        inside = np.asarray(((points >= self.low) & (points <= self.high)).all(1))
        if self.position is None:
            return inside
        away = np.floor(points / self.grid.spacing + 0.5) * self.grid.spacing - self.position
        return inside & (np.where(self.grid.spans, away**2, 0).sum(1) <= self.radius**2)


@dataclass(frozen=True)
class RecordedCells:
    """What a sensor saw from near the centres of cells.

    Attributes:
        centres: [k, 3], 0 along axes that the grid does not span.
        spans: bool [3], the axes of the grid.
        reach: metres from a centre.
    """

    centres: np.ndarray
    spans: np.ndarray
    reach: float

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.centres)

    def covers(self, points: np.ndarray) -> np.ndarray:
        """See `Coverage`."""
        away, _ = self._tree.query(points * self.spans, distance_upper_bound=self.reach)
        return np.isfinite(away)


@dataclass(frozen=True)
class Either:
    """The union of two regions."""

    one: Coverage
    other: Coverage

    def covers(self, points: np.ndarray) -> np.ndarray:
        """See `Coverage`."""
        return self.one.covers(points) | self.other.covers(points)


def reach_of(points: np.ndarray, key: CellKey, grid: Grid) -> float:
    """Metres along the grid's axes from a cell's centre to the farthest of its points [n, 3]; 0 without points."""
    away = (np.asarray(points, np.float64) - grid.centres_of(np.array([key]))) * grid.spans
    return float(np.sqrt((away**2).sum(1).max(initial=0)))


def coverage_of(
    reaches: dict[CellKey, float], settings: SubmapSettings, position: np.ndarray | None = None
) -> Coverage:
    """The region that cells can contain.

    Args:
        reaches: `reach_of` each cell that is loaded.
        settings: of the store.
        position: where the sensor was when the cells within R' of it were loaded, [3]; None: all cells are.
    """
    grid = Grid(settings.spacing, settings.axes)
    corner = settings.spacing / 2 * np.sqrt(grid.spans.sum())
    recorded = [key for key, reach in reaches.items() if reach > CoverageTuning.min_beyond * corner]
    cut = [key for key in reaches if key not in set(recorded)]
    if not recorded:
        return _cut(cut, grid, settings, position)
    # The sensor was up to R from the centre.
    farthest = min(settings.sensor_range, max(reaches[key] for key in recorded))
    reach = max(farthest - settings.radius, farthest / 2)
    seen = RecordedCells(grid.centres_of(np.array(recorded)), grid.spans, reach)
    return Either(seen, _cut(cut, grid, settings, position)) if cut else seen


def _cut(
    keys: Collection[CellKey], grid: Grid, settings: SubmapSettings, position: np.ndarray | None
) -> CutCells | Everywhere:
    if not keys:
        return Everywhere()
    centres, half = grid.centres_of(np.array(list(keys))), settings.spacing / 2
    low = np.where(grid.spans, centres.min(0) - half, -np.inf)
    high = np.where(grid.spans, centres.max(0) + half, np.inf)
    return CutCells(grid, low, high, None if position is None else np.array(position), settings.partial_radius)
