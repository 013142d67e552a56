# SPDX-License-Identifier: Apache-2.0
"""Every number of the grid of sub-maps, documented. The letters S, R, T and R' are those of SRT-PM."""

from __future__ import annotations

from typing import Literal

from ggslam.system.settings import setting, settings_class

GridAxes = Literal["xyz", "xz", "xy"]


@settings_class(frozen=True)
class SubmapSettings:
    """Grid, what is recorded, and what is held in memory. A store keeps the settings that it was created with."""

    spacing: float = setting(2.0, 1e-3, 1e6, "m")
    """S: edge of a cell; cell centres are the multiples of it, so that one lies at the world's origin."""
    axes: GridAxes = "xyz"
    """World axes that the grid spans. Along an axis left out a cell has no end: "xz" for a camera whose first pose was
    level (y points down), "xy" for a world whose z points up."""
    radius: float = setting(1.0, 0, 1e6, "m")
    """R: a cell is recorded while the sensor is at most this far from its centre, along the grid's axes. The cells'
    corners are within reach of a centre from S/2 sqrt(number of axes) on."""
    refresh: float = setting(300.0, 0, 1e12, "s")
    """T: time that must have passed before a cell is recorded again."""
    partial_radius: float = setting(10.0, 0, 1e7, "m")
    """R': the partial map is the union of the cells whose centres are at most this far from the sensor."""
    sensor_range: float = setting(10.0, 1e-3, 1e6, "m")
    """Points farther than this from the sensor are not recorded."""
    voxel: float = setting(0.05, 0, 1e3, "m")
    """Of the points in a cube with this edge one is recorded, their mean; 0: all of them."""
    ratio: float = setting(1.0, 1e-6, 1)
    """Share of the points that is recorded, after `voxel`, evenly taken."""
    change_distance: float = setting(0.1, 1e-6, 1e6, "m")
    """A point of a refreshed cell has changed if no point of the other recording is so near."""
    lookahead: float = setting(4.0, 0, 1e6, "m")
    """Cells around the place this far ahead along the motion are loaded in the background; 0: none are."""
    cache_megabytes: float = setting(256.0, 0, 1e9, "MB")
    """Most that decoded cells kept for later take; the partial map itself is not among them."""
