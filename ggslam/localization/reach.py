# SPDX-License-Identifier: Apache-2.0
"""Lengths that follow what a scanner sees: how far the map in memory reaches (R' of SRT-PM), and how far the sensor
goes before that map is put together anew.

Most of a scan's points lie within R'; farther ones are few and add little. Between shelves that is some metres, in a
hall or on a street many. Where the map is dense R' is less, so that it never holds more than a number of points. A fast
sensor goes farther between two maps, which then reach farther by as much.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from ggslam.errors import ConfigError
from ggslam.scene.frame import Frame
from ggslam.system.tuning import Tuning

if TYPE_CHECKING:
    from ggslam.localization.surface import PartialSurface

AUTO: Final = "auto"
"""As a radius: what the sensor sees."""
MOST_METRES: Final = 1e7
"""Largest radius."""


class ReachTuning(Tuning):
    """How far a map has to reach."""

    percentile = 95
    """Percentage of the points of a scan, the nearest ones, that the map has to reach."""
    factor = 1.2
    """Radius over the range of those points."""


class AdaptiveReachTuning(Tuning):
    """How the map in memory follows the sensor."""

    min_cells = 2.0
    """Smallest R', in edges of a cell."""
    max_points = 500_000
    """Most points of the map within R', about."""
    grow = 1.1
    """A greater R' is used from this ratio to the present one on."""
    shrink = 0.75
    """A smaller R' is used from this ratio on."""
    scans_apart = 5.0
    """Scans between two maps at the present speed."""
    max_step = 0.3
    """Largest distance between two maps over the reach of the sensor."""
    pixel_step = 8
    """Of a depth image every such row and column is looked at."""


def reach_of_ranges(ranges: np.ndarray) -> float:
    """Metres that the map of a sensor has to reach that measured `ranges` [n], metres; 0 of none."""
    ranges = ranges[np.isfinite(ranges) & (ranges > 0)]
    return float(np.percentile(ranges, ReachTuning.percentile)) * ReachTuning.factor if len(ranges) else 0.0


def scan_ranges(points: np.ndarray) -> np.ndarray:
    """Of a scan's points [n, 3], metres [n]."""
    return np.asarray(np.linalg.norm(points[:, :3], axis=1))


def frame_ranges(frame: Frame) -> np.ndarray:
    """Of some pixels of a depth image, metres [n]; 0 or infinite where nothing was measured."""
    few = np.s_[:: AdaptiveReachTuning.pixel_step, :: AdaptiveReachTuning.pixel_step]
    return np.asarray(frame.depth[few] * np.linalg.norm(frame.camera.rays()[few], axis=-1)).ravel()


class AdaptiveReach:
    """Gives a partial surface the lengths that suit each scan or frame.

    Args:
        surface: whose map has the R' of its settings until something was seen.
        ranges: what an item measured, metres [n].
    """

    def __init__(self, surface: PartialSurface, ranges: Callable[[Any], np.ndarray]) -> None:
        self._surface, self._ranges = surface, ranges
        self.radius, self.step = max(surface.map.radius, surface.map.settings.spacing), 0.0
        """R', and how far the sensor goes before the map is put together anew, metres; 0: into another cell."""

    def adapt(self, item: Any, moved: float) -> None:
        """Before an item is located, `moved` metres from the last one."""
        seen, edge = reach_of_ranges(self._ranges(item)), self._surface.map.settings.spacing
        if not seen:
            return
        tuning = AdaptiveReachTuning
        step = max(edge, min(tuning.scans_apart * moved, tuning.max_step * seen))
        wanted = max(tuning.min_cells * edge, min(seen + step - edge, self._clutter_limit()))
        if not tuning.shrink < wanted / self.radius < tuning.grow:
            self.radius = wanted
        self.step = step
        self._surface.set_reach(self.radius, self.step)

    def _clutter_limit(self) -> float:
        """Metres within which the map has about so many points, as dense as it is in memory; before anything is in
        memory, the R' of the settings."""
        points = self._surface.points
        return self.radius * float(np.sqrt(AdaptiveReachTuning.max_points / points)) if points else self.radius


def parse_radius(text: float | str) -> float | Literal["auto"]:
    """Metres, or `AUTO`. Raises ConfigError for anything else."""
    if text == AUTO:
        return AUTO
    try:
        radius = float(text)
    except (TypeError, ValueError):
        radius = np.nan
    if not 0 <= radius <= MOST_METRES:
        raise ConfigError(f"`radius`: expected a number from 0 to {MOST_METRES:g} (metres) or {AUTO}, found {text!r}")
    return radius
