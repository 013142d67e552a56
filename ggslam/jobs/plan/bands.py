# SPDX-License-Identifier: Apache-2.0
"""A robot's band of a distance field as cells to plan on, and the floor of a field that nothing else is known of."""

from __future__ import annotations

import numpy as np

from ggslam.driving.plan_maps import floor_cells
from ggslam.driving.robot import Robot
from ggslam.scene.poses import inverse, translation
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.floor_frame import floor_from_map
from ggslam.volumes.slices import SlicePlane, slice_field
from ggslam.volumes.tsdf import SIDE
from ggslam.volumes.upright import estimate_up

Extent = tuple[tuple[float, float], tuple[float, float]]
"""Corners (x, y) of a rectangle on the floor, metres."""


def band_cells(
    field: DistanceField, T_floor_map: np.ndarray, robot: Robot, cell: float, reach: float, unknown: bool,
    extent: Extent | None = None,
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

    Returns:
        Where the first cell begins on the floor (x, y), metres, and clearances float32 [Y, X].
    """
    low, high = extent or _extent(field, T_floor_map)
    T_map_floor = inverse(T_floor_map)
    plane = SlicePlane(T_map_floor[:3, 3], T_map_floor[:3, 0], T_map_floor[:3, 1], low, high)
    cut = slice_field(field, plane, cell, robot.band)
    clearance = floor_cells(cut.occupied[::-1], cut.free[::-1], cell, reach, unknown, field.tsdf.context)
    return cut.plane.low, clearance


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


def _extent(field: DistanceField, T_floor_map: np.ndarray) -> Extent:
    edge = SIDE * field.voxel
    corners = np.concatenate([field.coordinates() + shift for shift in np.ndindex(2, 2, 2)]) * edge + field.origin
    if not len(corners):
        return (0.0, 0.0), (0.0, 0.0)
    on_floor = corners @ T_floor_map[:3, :3].T + T_floor_map[:3, 3]
    low, high = on_floor[:, :2].min(axis=0), on_floor[:, :2].max(axis=0)
    return (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))
