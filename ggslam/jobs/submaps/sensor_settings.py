# SPDX-License-Identifier: Apache-2.0
"""Settings of a new store that suit the sensor: a depth camera sees some metres, a LiDAR on a street a hundred.

Most of a scan's points lie within R'; farther ones are few and add little. A scanner's sub-maps reach far beyond their
cells, so cells of a third of R' are enough of them. Where a whole cloud is cut, a cell has only what lies in it, and
smaller cells follow the ball of R' better. Depth cameras and rooms get `INDOORS`, scanners that see no farther than
10 m the same with a greater R: a walk need not come near the centres of its cells, which lie one above another, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ggslam.jobs.submaps.stores import INDOORS
from ggslam.localization.reach import reach_of_ranges
from ggslam.localization.scans import ScanSequence
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.tuning import Tuning


class StoreSensorTuning(Tuning):
    """How settings of a store follow from its sensor."""

    scans = 5
    """Scans that are read, spread over the recording."""
    farthest_percentile = 99
    """Percentile of the ranges that is taken for the farthest."""
    length_step_m = 5.0
    """Lengths are rounded up to whole multiples of this, in metres."""
    max_length_m = 100.0
    """Largest radius and sensor range, in metres."""
    cells_in_reach = 3
    """R' over the edge of a cell, for scans."""
    cells_in_cloud_reach = 6
    """R' over the edge of a cell, for a cloud that is cut into cells."""
    radius_in_cells = 0.9
    """R over the edge of a cell: above 0.87 every place in a cube is within R of its centre."""
    voxels_in_reach = 300
    """R' over the edge of a voxel."""
    min_outdoor_extent_m = 60.0
    """A cloud longer than this along two axes is taken for an outdoor scene, in metres."""
    outdoor_radius_m = 30.0
    """R' of an outdoor cloud, in metres."""
    samples = 200_000
    """Points that the spacing of a cloud is measured from, about."""


_SHORT = replace(INDOORS, radius=StoreSensorTuning.radius_in_cells * INDOORS.spacing)
"""Of a scanner that sees no farther than rooms reach."""


def settings_of_scans(scans: ScanSequence, cut: bool = False) -> SubmapSettings:
    """What suits the scanner of a recording; `cut`: for a cloud that is cut into cells.

    Raises:
        FormatError: a scan is damaged.
    """
    chosen = np.unique(np.linspace(0, len(scans) - 1, StoreSensorTuning.scans).round().astype(int))
    ranges = np.concatenate([np.linalg.norm(scans.scan(number).points, axis=1) for number in chosen.tolist()])
    ranges = ranges[np.isfinite(ranges) & (ranges > 0)]
    if not len(ranges):
        return _SHORT
    farthest = float(np.percentile(ranges, StoreSensorTuning.farthest_percentile))
    return _of_reach(reach_of_ranges(ranges), farthest, cut)


def settings_of_cloud(points: np.ndarray) -> SubmapSettings:
    """What suits a cloud [n, 3] that is cut into cells, where no scanner is known: by its size."""
    few = points[:: max(1, len(points) // StoreSensorTuning.samples)]
    few = few[np.isfinite(few).all(1)]
    if not len(few):
        return INDOORS
    low, high = np.percentile(few, [1, 99], axis=0)
    if np.sort(high - low)[1] < StoreSensorTuning.min_outdoor_extent_m:
        return INDOORS
    return _of_reach(StoreSensorTuning.outdoor_radius_m, StoreSensorTuning.outdoor_radius_m, cut=True)


def with_chosen(settings: SubmapSettings, chosen: Mapping[str, Any]) -> SubmapSettings:
    """Settings with fields that were set on purpose; R goes with an edge of a cell that was."""
    edge = chosen.get("spacing")
    if edge is not None and "radius" not in chosen and settings.radius != INDOORS.radius:
        settings = replace(settings, radius=StoreSensorTuning.radius_in_cells * edge)
    return replace(settings, **chosen)


def in_words(settings: SubmapSettings) -> str:
    """The lengths in one line."""
    s = settings
    return (
        f"R' {s.partial_radius:g} m, cells of {s.spacing:g} m, R {s.radius:g} m, points up to {s.sensor_range:g} m, "
        f"voxels of {100 * s.voxel:g} cm"
    )


def _of_reach(reach: float, farthest: float, cut: bool) -> SubmapSettings:
    if reach <= INDOORS.partial_radius:
        return _SHORT
    radius = min(StoreSensorTuning.max_length_m, _round_up(reach))
    spacing = max(
        INDOORS.spacing,
        _handy(radius / (StoreSensorTuning.cells_in_cloud_reach if cut else StoreSensorTuning.cells_in_reach)),
    )
    return replace(
        INDOORS, partial_radius=radius, spacing=spacing, radius=StoreSensorTuning.radius_in_cells * spacing,
        sensor_range=min(StoreSensorTuning.max_length_m, max(radius, _round_up(farthest))),
        voxel=_handy(radius / StoreSensorTuning.voxels_in_reach),
        change_distance=max(INDOORS.change_distance, 2 * radius / StoreSensorTuning.voxels_in_reach),
        lookahead=max(INDOORS.lookahead, spacing),
    )  # fmt: skip


def _handy(metres: float) -> float:
    """The next 1, 2 or 5 times a power of ten up to 5 % above: maps of the same place, of which one is moved by whole
    kilometres, then have the same cells and voxels."""
    power = 10.0 ** math.floor(math.log10(1.05 * metres))
    return round(max(digit for digit in (1, 2, 5) if digit * power <= 1.05 * metres) * power, 9)


def _round_up(metres: float) -> float:
    return StoreSensorTuning.length_step_m * math.ceil(metres / StoreSensorTuning.length_step_m - 1e-9)
