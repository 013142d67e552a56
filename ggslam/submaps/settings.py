# SPDX-License-Identifier: Apache-2.0
"""Every number of the grid of sub-maps, documented. The letters S, R, T and R' are those of SRT-PM."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from ggslam.errors import ConfigError, check_ranges

GridAxes = Literal["xyz", "xz", "xy"]


@dataclass(frozen=True)
class SubmapSettings:
    """Grid, what is recorded, and what is held in memory. A store keeps the settings that it was created with."""

    spacing: float = 2.0
    """S: edge of a cell in metres; cell centres are the multiples of it, so that one lies at the world's origin."""
    axes: GridAxes = "xyz"
    """World axes that the grid spans. Along an axis left out a cell has no end: "xz" for a camera whose first pose was
    level (y points down), "xy" for a world whose z points up."""
    radius: float = 1.0
    """R: a cell is recorded while the sensor is at most this far from its centre, in metres, along the grid's axes. The
    cells' corners are within reach of a centre from S/2 sqrt(number of axes) on."""
    refresh: float = 300.0
    """T: seconds that must have passed before a cell is recorded again."""
    partial_radius: float = 10.0
    """R': the partial map is the union of the cells whose centres are at most this far from the sensor, in metres."""
    sensor_range: float = 10.0
    """Points farther than this from the sensor are not recorded, in metres."""
    voxel: float = 0.05
    """Of the points in a cube with this edge one is recorded, their mean; metres; 0: all of them."""
    ratio: float = 1.0
    """Share of the points that is recorded, after `voxel`, evenly taken."""
    change_distance: float = 0.1
    """A point of a refreshed cell has changed if no point of the other recording is so near, in metres."""
    lookahead: float = 4.0
    """Cells around the place this far ahead along the motion are loaded in the background; metres, 0: none are."""
    cache_megabytes: float = 256.0
    """Most that decoded cells kept for later take, in 10^6 bytes; the partial map itself is not among them."""

    def __post_init__(self) -> None:
        if self.axes not in get_args(GridAxes):
            raise ConfigError(f"SubmapSettings.axes: expected {', '.join(get_args(GridAxes))}, found {self.axes!r}")
        ranges = {
            "spacing": (1e-3, 1e6),
            "radius": (0, 1e6),
            "refresh": (0, 1e12),
            "partial_radius": (0, 1e7),
            "sensor_range": (1e-3, 1e6),
            "voxel": (0, 1e3),
            "ratio": (1e-6, 1),
            "change_distance": (1e-6, 1e6),
            "lookahead": (0, 1e6),
            "cache_megabytes": (0, 1e9),
        }  # fmt: skip
        check_ranges(self, ranges)
