# SPDX-License-Identifier: Apache-2.0
"""How far points of a surface lie from the surface, on shapes whose distance is a formula."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from ggslam.formats.voxel_cloud import VoxelCloud, join_clouds
from ggslam.scene.camera import Camera
from ggslam.volumes.posed_view import PosedView
from ggslam.volumes.surface_points import surface_points

CAMERA = Camera(240, 180, 200.0, 200.0, 119.5, 89.5)
CENTRE, RADIUS, WALL = np.array([0.03, -0.02, 1.2]), 0.25, 2.004
VOXEL = 0.01


def look(places: list[np.ndarray], noise: float, number: int, coarse: bool) -> PosedView:
    """A ball before a wall, from a place, looking along z."""
    camera = CAMERA.scale(0.25) if coarse else CAMERA
    rays, place = camera.rays().astype(float), places[number]
    depth = np.full(rays.shape[:2], WALL - place[2])
    away = CENTRE - place
    along, length = rays @ away, (rays**2).sum(-1)
    inside = along**2 - length * (away @ away - RADIUS**2)
    ball = inside > 0
    depth[ball] = ((along - np.sqrt(np.where(ball, inside, 0))) / length)[ball]
    generator = np.random.default_rng(number)
    depth += noise * generator.normal(size=depth.shape)
    T = np.eye(4)
    T[:3, 3] = place
    color = np.where(ball[..., None], [200, 40, 20], [10, 60, 180]).astype(np.uint8)
    return PosedView(depth.astype(np.float32), camera, T, color, np.where(ball, 7, 2).astype(np.uint16))


def places(count: int, reach: float) -> list[np.ndarray]:
    return [np.array([x, 0.02 * (k % 3), 0.0]) for k, x in enumerate(np.linspace(-reach, reach, count))]


def distance(points: np.ndarray) -> np.ndarray:
    """Metres from the ball or the wall, whichever is nearer."""
    return np.minimum(np.abs(np.linalg.norm(points - CENTRE, axis=1) - RADIUS), np.abs(points[:, 2] - WALL))


def cloud_of(count: int = 9, reach: float = 0.3, noise: float = 0.0, **options: int) -> VoxelCloud:
    return join_clouds(surface_points(partial(look, places(count, reach), noise), count, VOXEL, True, **options))


def test_points_lie_on_the_surface_and_not_in_the_middle_of_their_voxels() -> None:
    cloud = cloud_of()
    off = distance(cloud.points)
    assert np.median(off) < 0.0002 and np.quantile(off, 0.95) < 0.001
    assert np.median(distance(cloud.origin + VOXEL * cloud.grid)) > 0.001  # the middles of their voxels are off
    assert np.abs(cloud.offsets).max() <= 0.5  # type: ignore[arg-type]


def test_noise_of_single_images_averages_out() -> None:
    assert np.median(distance(cloud_of(25, 0.3, noise=0.01).points)) < 0.004


def test_a_wall_gives_one_point_for_each_voxel_of_it() -> None:
    cloud = cloud_of()
    wall = np.abs(cloud.points[:, 2] - WALL) < 0.005
    columns, counts = np.unique(cloud.grid[wall][:, :2], axis=0, return_counts=True)
    assert (counts == 1).all()
    extent = np.ptp(columns, axis=0) + 1
    assert len(columns) > 0.95 * extent.prod()


def test_colours_and_ids_are_those_of_the_surface() -> None:
    cloud = cloud_of()
    assert cloud.object_id is not None
    ball = np.abs(np.linalg.norm(cloud.points - CENTRE, axis=1) - RADIUS) < 0.003
    front = ball & (cloud.points[:, 2] < CENTRE[2] - 0.1)  # away from the outline
    assert front.sum() > 500 and (cloud.object_id[front] == 7).all()
    assert np.abs(cloud.colors[front].astype(int) - [200, 40, 20]).max() <= 2
    wall = cloud.points[:, 2] > WALL - 0.003
    assert (cloud.object_id[wall] == 2).mean() > 0.99


@pytest.mark.long("a walk of thirty views, fused twice")
def test_what_is_handed_out_early_is_what_all_at_once_gives() -> None:
    """A walk along a wall, of which no more is held than a few blocks."""
    whole = cloud_of(30, 3.0)
    clouds = list(surface_points(partial(look, places(30, 3.0), 0.0), 30, VOXEL, True, most_blocks=50))
    assert len(clouds) > 5
    parts = join_clouds(clouds)
    assert len(parts) == sum(map(len, clouds)) == len(whole)
    np.testing.assert_array_equal(parts.grid, whole.grid)
    np.testing.assert_array_equal(parts.object_id, whole.object_id)
    np.testing.assert_allclose(parts.points, whole.points, atol=1e-9)


@pytest.mark.parametrize("count", [0, 2])
def test_nothing_seen_gives_no_cloud(count: int) -> None:
    def nothing(number: int, coarse: bool) -> PosedView:
        camera = CAMERA.scale(0.25) if coarse else CAMERA
        return PosedView(np.zeros((camera.height, camera.width), np.float32), camera, np.eye(4))

    assert list(surface_points(nothing, count, VOXEL)) == []
