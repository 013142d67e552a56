# SPDX-License-Identifier: Apache-2.0
"""Settings of the grid of sub-maps. The letters S, R, T and R' are those of SRT-PM."""

from __future__ import annotations

from typing import Literal

from ggslam.system.settings import setting, settings_class, tuning_class

GridAxes = Literal["xyz", "xz", "xy"]


@tuning_class(frozen=True)
class SubmapTuning:
    """Numbers of a store of cells."""

    ratio: float = setting(1.0, 1e-6, 1)
    """Share of the points that is recorded, after `voxel`."""
    change_distance: float = setting(0.1, 1e-6, 1e6, "m")
    """A point of a refreshed cell has changed if no other point is closer than this."""
    lookahead: float = setting(4.0, 0, 1e6, "m")
    """Cells around the place this far ahead along the motion are loaded in the background; 0: none."""


@settings_class(frozen=True)
class SubmapSettings(SubmapTuning):
    """Grid, recording and memory of a store of cells. A store keeps the settings it was made with."""

    spacing: float = setting(2.0, 1e-3, 1e6, "m")
    """S, edge of a cell. Centres are multiples of it, so one lies at the origin."""
    axes: GridAxes = "xyz"
    """World axes of the grid; cells are unbounded along the others. xz: a camera that started level (y down); xy: a
    world with z up."""
    radius: float = setting(1.0, 0, 1e6, "m")
    """R: a cell is recorded while the sensor is at most this far from its centre. All corners are reached from S/2
    sqrt(number of axes) on."""
    refresh: float = setting(300.0, 0, 1e12, "s")
    """T: least time before a cell is recorded again."""
    partial_radius: float = setting(10.0, 0, 1e7, "m")
    """R': the partial map is made of the cells with centres at most this far from the sensor."""
    sensor_range: float = setting(10.0, 1e-3, 1e6, "m")
    """Farther points are not recorded."""
    voxel: float = setting(0.05, 0, 1e3, "m")
    """One point, the mean, is recorded per cube of this edge; 0: all points."""
    cache_megabytes: float = setting(256.0, 0, 1e9, "MB")
    """Memory for decoded cells, besides the partial map."""
