# SPDX-License-Identifier: Apache-2.0
"""A robot's band of a distance field as cells to plan on, and the floor of a field that nothing else is known of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ggslam.driving.bands import band_map, floor_plane
from ggslam.driving.robot import Robot
from ggslam.scene.poses import translation
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.floor_frame import floor_from_map
from ggslam.volumes.upright import estimate_up

Extent = tuple[tuple[float, float], tuple[float, float]]
"""Corners (x, y) of a rectangle on the floor, metres."""


def band_cells(
    field: DistanceField, T_floor_map: np.ndarray, robot: Robot, cell: float, reach: float, unknown: bool,
    extent: Extent | None = None, floor_seen: bool = True,
) -> tuple[tuple[float, float], np.ndarray]:  # fmt: skip
    """A robot's band.

    Args:
        field: up to date.
        T_floor_map: float64 [4, 4].
        robot: what drives.
        cell: edge of a cell, metres.
        reach: metres; what is farther from obstacles counts as this far.
        unknown: whether cells that nobody saw may be entered.
        extent: part of the floor; None: as far as the field's blocks reach.
        floor_seen: whether it is a floor, and no guess: where it falls away is then an obstacle.

    Returns:
        Where the first cell begins on the floor (x, y), metres, and clearances float32 [Y, X].
    """
    plane = floor_plane(field, T_floor_map)
    plane = plane if extent is None else replace(plane, low=extent[0], high=extent[1])
    band = band_map(field, plane, robot, cell, floor_seen)
    clearance = np.minimum(band.distance, np.float32(reach))
    if not unknown:
        clearance = np.where(band.free | band.occupied, clearance, np.float32(np.nan))
    return band.plane.low, clearance[::-1]


def floor_of_field(field: DistanceField, poses: np.ndarray | None = None) -> np.ndarray:
    """T_floor_map [4, 4] from a field's surfaces.

    Args:
        field: up to date.
        poses: T_map_camera [N, 4, 4] of what looked; None: unknown, the map's y axis points about downwards.
    """
    points, normals = field.surface()
    there = np.eye(4)[None] if poses is None else poses
    near = there.copy()
    near[:, :3, 3] -= field.origin if poses is not None else 0
    upright = estimate_up(near, points - field.origin, normals)
    return np.asarray(floor_from_map(upright, near) @ translation(-field.origin))
