# SPDX-License-Identifier: Apache-2.0
"""What is thinner than a voxel is an obstacle in occupancy, distance field and ROS map alike: exact poles before a
wall."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from analytic_scenes import Box, Scene, Union, looking_at, render_depth, small_camera

from ggslam.driving.bands import HeightLayers
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.measured_points import measured_octants
from ggslam.volumes.occupancy import OCCUPIED, OccupancyMap
from ggslam.volumes.occupancy_settings import OccupancySettings
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.slices import plane_at_height
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.tsdf_torch import TorchTsdf

CAMERA = small_camera(320, 240)
ROOM = Box((-2.03, -1.02, -1.01), (2.01, 1.03, 4.52), True)
UP = np.array([0.0, -1.0, 0.0])
Maps = tuple[TsdfMap, DistanceField, OccupancyMap]


def pole(x: float, z: float, thickness: float = 0.03) -> Box:
    half = thickness / 2
    return Box((x - half, -1.5, z - half), (x + half, 1.5, z + half))


def poses(n: int) -> list[np.ndarray]:
    places = np.linspace(-0.5, 0.5, n)
    return [looking_at(np.array([x, 0.1 * x, 0.05]), np.array([0.2 * x, 0.0, 3.0])) for x in places]


def seen(scene: Scene, voxel: float, views: list[np.ndarray]) -> Maps:
    tsdf, occupancy = TsdfMap(TsdfSettings(voxel=voxel)), OccupancyMap(voxel, OccupancySettings.with_raised_odds())
    for T in views:
        depth = render_depth(scene, CAMERA, T)
        tsdf.integrate(depth, CAMERA, T)
        occupancy.insert_depth(depth, CAMERA, T)
    field = DistanceField(tsdf)
    field.update()
    return tsdf, field, occupancy


@pytest.mark.parametrize("voxel", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("z", [1.0, 2.0, 3.4])
@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5, 0.8])
def test_a_pole_is_an_obstacle_in_all_maps(voxel: float, z: float, shift: float) -> None:
    x = 0.1 + shift * voxel
    _, field, occupancy = seen(Union((ROOM, pole(x, z))), voxel, poses(5))
    heights = np.linspace(-0.3, 0.3, 13)
    front = np.stack([np.full(13, x), heights, np.full(13, z - 0.015)], 1)
    before = front - [0, 0, 0.3]
    found = field.query(before)
    assert found.known.all() and np.abs(found.distance - 0.3).max() < 0.55 * voxel + 0.02
    assert (field.query(front - [0, 0, 1e-4]).distance <= 0.9 * voxel).all()
    assert (occupancy.states(front + [0, 0, 1e-4]) == OCCUPIED).mean() > 0.9
    cut = HeightLayers(field, plane_at_height(field, UP, 0.0), voxel).between(-0.3, 0.3)
    assert not cut.free[cells_of(cut, front)].any()
    beside = cv2.dilate(cut.occupied.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert beside[cells_of(cut, front)].all()


def cells_of(cut, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    """Rows and columns of the cells that points lie in."""
    x, y = ((points - cut.plane.origin) @ axis for axis in (cut.plane.x_axis, cut.plane.y_axis))
    column = np.floor((x - cut.plane.low[0]) / cut.resolution).astype(int)
    from_bottom = np.floor((y - cut.plane.low[1]) / cut.resolution).astype(int)
    return cut.known.shape[0] - 1 - from_bottom, column


@pytest.mark.parametrize("voxel", [0.04, 0.1])
def test_the_field_has_all_that_occupancy_has(voxel: float) -> None:
    scene = Union((ROOM, pole(-0.4, 1.7), pole(0.3, 2.6, 0.01), Box((0.6, -0.2, 1.5), (0.62, 0.1, 2.1))))
    tsdf, field, occupancy = seen(scene, voxel, poses(6))
    centres, sizes = occupancy.occupied_centers()
    centres = centres[np.isclose(sizes, voxel)]
    assert len(centres) > 500
    # Beyond the last voxel that the TSDF knows there is nothing to compare with.
    found = field.query(centres.astype(np.float64))
    assert found.known.mean() > 0.995
    distance = np.abs(found.distance[found.known]) / voxel
    # The nearest site is in the voxel, or half a voxel from the centre of one at its faces.
    assert (distance <= np.sqrt(3) / 2).mean() > 0.99 and distance.max() < 1.51
    occupied = {tuple(c) for c in np.floor(centres / voxel).astype(int).tolist()}
    counted = {tuple(c) for c in np.floor(measured_octants(tsdf) / voxel).astype(int).tolist()}
    assert len(occupied - counted) <= 0.005 * len(occupied)


@pytest.mark.parametrize("voxel", [0.05, 0.1])
def test_the_ros_map_has_all_surfaces_and_nothing_else(voxel: float) -> None:
    scene = Union((ROOM, pole(-0.4, 1.7), pole(0.3, 2.6), Box((0.6, -0.4, 1.5), (0.9, 0.4, 2.1))))
    views = poses(6)
    _, field, _ = seen(scene, voxel, views)
    band = (-0.35, 0.35)
    cut = HeightLayers(field, plane_at_height(field, UP, 0.0), voxel).between(*band)
    surface = []
    for T in views:
        points = CAMERA.back_project(render_depth(scene, CAMERA, T)).reshape(-1, 3).astype(np.float64)
        points = points @ T[:3, :3].T + T[:3, 3]
        surface.append(points[np.abs(points[:, 1]) < 0.35])
    surface = np.concatenate(surface)
    rows, columns = cells_of(cut, surface)
    assert cut.free.sum() > 200 and not cut.free[rows, columns].any()
    flat = (surface - cut.plane.origin) @ np.stack([cut.plane.x_axis, cut.plane.y_axis], 1)
    row, column = np.nonzero(cut.occupied)
    low = np.stack([column, cut.known.shape[0] - 1 - row], 1) * voxel + cut.plane.low
    gap = [np.linalg.norm(np.maximum(np.maximum(c - flat, flat - c - voxel), 0), axis=1).min() for c in low]
    assert max(gap) < 1.001 * voxel


def test_a_pole_taken_away_goes_and_updates_are_exact() -> None:
    voxel, views = 0.1, poses(4)
    tsdf, field, _ = seen(Union((ROOM, pole(0.1, 2.0))), voxel, views)
    assert (np.abs(field.surface()[1]).sum(1) == 0).any()
    for _ in range(3):
        for T in views:
            tsdf.integrate(render_depth(ROOM, CAMERA, T), CAMERA, T)
            field.update()
            anew = DistanceField(tsdf)
            anew.update()
            at = anew.coordinates()
            assert np.array_equal(field.read(at), anew.read(at), equal_nan=True)
    assert field.query(np.array([[0.1, 0.0, 1.9]])).distance[0] > 0.8


def test_torch_counts_the_same_points() -> None:
    settings, scene = TsdfSettings(voxel=0.1), Union((ROOM, pole(0.1, 2.0)))
    tsdf, other = TsdfMap(settings), TorchTsdf(settings)
    for T in poses(3):
        depth = render_depth(scene, CAMERA, T)
        tsdf.integrate(depth, CAMERA, T)
        other.integrate(depth, CAMERA, T)
    one, two = ({tuple(p) for p in measured_octants(m).round(4).tolist()} for m in (tsdf, other.to_native()))
    assert len(one) > 1000 and len(one ^ two) <= 0.005 * len(one)
