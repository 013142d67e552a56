# SPDX-License-Identifier: Apache-2.0
"""Holes in a floor, at exact places: a robot must not drive into them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rooms import room_distance, room_field, turned

from ggslam.driving.bands import BandMap, band_map
from ggslam.driving.inflation import INSCRIBED_COST, inflated_cost
from ggslam.driving.robot import Robot
from ggslam.jobs.plan.plan_path import plan_path
from ggslam.scene.poses import inverse, transform_points
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.floor_frame import FLOOR_FILE, write_floor_file
from ggslam.volumes.output_frame import OutputFrame
from ggslam.volumes.tsdf_file import save_tsdf

T_FLOOR_MAP = turned()
PIT = np.array([[1.87, 1.03], [2.61, 1.58]])
"""Lower and upper corner (x, y) of a hole in the floor, metres."""
CELL = 0.05
ROBOT = Robot(0.4, 0.18)


def pit_room(depth: float, voxel: float = 0.04) -> DistanceField:
    """The room with the hole, `depth` metres deep."""

    def distance(p: np.ndarray) -> np.ndarray:
        low, high = np.array([*PIT[0], -depth]), np.array([*PIT[1], 0.5])
        return np.maximum(room_distance(p), np.minimum(p - low, high - p).min(-1))

    return room_field(T_FLOOR_MAP, voxel, distance, depth)


def gap_to_pit(places: np.ndarray) -> np.ndarray:
    """Metres from places [..., 2] to the hole; negative in it."""
    q = np.abs(places - PIT.mean(0)) - (PIT[1] - PIT[0]) / 2
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


@pytest.mark.parametrize("voxel", [0.03, 0.04, 0.1])
def test_a_hole_is_an_obstacle_where_it_is(voxel: float) -> None:
    field = pit_room(0.5, voxel)
    band, without = (band_map(field, T_FLOOR_MAP, ROBOT, CELL, seen) for seen in (True, False))
    gap = gap_to_pit(band.grid.centres())
    assert without.free[gap < -0.01].all()  # nothing is at the robot's heights there
    edge = CELL / 2 + 0.5 * voxel
    new = band.occupied & ~without.occupied
    assert new[gap < -edge].all() and not band.free[gap < -edge].any() and new.sum() > 50
    assert np.abs(gap[new & (gap > 0)]).max(initial=0) < edge
    around = (gap > edge) & (gap < 0.3)
    off = band.distance[around] - np.minimum(gap, without.distance)[around]
    assert around.sum() > 300 and np.abs(off).max() < edge and np.abs(off).mean() < 0.2 * (CELL + voxel)


def test_the_cost_keeps_a_robot_its_radius_away() -> None:
    band = band_map(pit_room(0.5), T_FLOOR_MAP, ROBOT, CELL)
    cost = inflated_cost(band, ROBOT.radius)
    gap = gap_to_pit(band.grid.centres())
    assert (cost[gap < ROBOT.radius - 0.045] >= INSCRIBED_COST).all()
    aside = (gap > 0.6) & (band.distance > 0.6)
    assert aside.any() and (cost[aside & band.free] == 0).all()


@pytest.mark.parametrize(("depth", "step", "falls"), [(0.03, 0.05, False), (0.2, 0.05, True), (0.2, 0.3, False)])
def test_what_a_robot_drives_over_it_drives_down(depth: float, step: float, falls: bool) -> None:
    band = band_map(pit_room(depth), T_FLOOR_MAP, Robot(0.5, 0.18, step), CELL)
    inside = gap_to_pit(band.grid.centres()) < -0.05
    assert band.occupied[inside].all() == falls and band.free[inside].any() != falls


def test_a_floor_without_holes_has_none() -> None:
    """A floor that is off by 2 cm, and one that is off by half a degree."""
    for voxel in (0.04, 0.1):
        field = room_field(T_FLOOR_MAP, voxel)
        for shift, tilt in ((0.02, 0.0), (-0.02, 0.0), (0.0, 0.5)):
            T = np.eye(4)
            a = np.radians(tilt)
            T[1:3, 1:3] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
            T[2, 3] = shift
            found: BandMap = band_map(field, T @ T_FLOOR_MAP, ROBOT, CELL)
            plain = band_map(field, T @ T_FLOOR_MAP, ROBOT, CELL, False)
            for name in ("occupied", "known", "distance", "behind"):
                assert np.array_equal(getattr(found, name), getattr(plain, name)), (voxel, shift, tilt, name)


def test_a_path_leads_around_a_hole(tmp_path: Path) -> None:
    field = pit_room(0.5)
    save_tsdf(tmp_path / "tsdf.npz", field.tsdf)
    ends = transform_points(np.array([[1.4, 1.3, 0.0], [2.95, 1.3, 0.0]]), inverse(T_FLOOR_MAP))
    lengths = []
    for seen in (True, False):
        write_floor_file(tmp_path / FLOOR_FILE, T_FLOOR_MAP, OutputFrame.map, seen)
        found = plan_path(tmp_path, ends[0], ends[1], robot=Robot(0.4, 0.12))
        assert found.is_found
        points = transform_points(found.points, T_FLOOR_MAP)
        steps = np.linspace(0, 1, 20)[:, None, None]
        along = (points[:-1] + steps * (points[1:] - points[:-1])).reshape(-1, 3)
        nearest = gap_to_pit(along[:, :2]).min()
        assert nearest > 0.12 - 0.045 if seen else nearest < -0.1
        lengths.append(found.length)
    assert lengths[0] > 1.1 * lengths[1]
