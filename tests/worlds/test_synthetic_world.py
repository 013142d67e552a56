# SPDX-License-Identifier: Apache-2.0
"""The generated world: rays held against brute force, surfaces against the boxes, ways that are free, work that does
not grow with the world."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.errors import ConfigError, SequenceError
from ggslam.scene.poses import inverse, so3_log, transform_points
from worlds.cloud import cloud_tiles, world_cloud
from worlds.plan import make_world
from worlds.scanner import Scanner
from worlds.walk import walk
from worlds.world import CELL, World, cast_rays

SCANNER = Scanner(16, 360)


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(40.0, 3)


@pytest.fixture(scope="module")
def poses(world: World) -> np.ndarray:
    return walk(world, 120.0, 1)


def in_box(world: World, points: np.ndarray, number: int) -> np.ndarray:
    """Points in the axes of a box, less its half extents, [n, 3]: how far they are beyond each pair of faces."""
    x, y, z, *half, angle = world.boxes[number]
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return np.abs((points - (x, y, z)) @ turn) - half


def distance(world: World, points: np.ndarray) -> np.ndarray:
    """Distance [n] to the nearest surface, from outside of all boxes positive, from inside negative."""
    nearest = np.minimum(points[:, 2], world.height - points[:, 2])
    for number in range(len(world.boxes)):
        q = in_box(world, points, number)
        signed = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)
        nearest = np.minimum(nearest, signed)
    return nearest


def brute_force(world: World, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Every ray against every face of every box, by crossing the face's plane."""
    best = np.where(directions[:, 2] > 0, world.height - origins[:, 2], -origins[:, 2]) / directions[:, 2]
    for number, (x, y, z, *half, angle) in enumerate(world.boxes):
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        o, d = (origins - (x, y, z)) @ turn, directions @ turn
        for axis in range(3):
            for sign in (-1, 1):
                t = (sign * half[axis] - o[:, axis]) / d[:, axis]
                within = in_box(world, origins + t[:, None] * directions, number) < 0
                hit = (t > 0) & np.delete(within, axis, 1).all(1)
                best = np.where(hit & (t < best), t, best)
    return best


def test_rays_end_where_brute_force_says() -> None:
    world = make_world(25.0, 5)
    rng = np.random.default_rng(0)
    origins = rng.uniform((0.1, 0.1, 0.1), (24.9, 24.9, 2.9), (1500, 3))
    origins = origins[distance(world, origins) > 0.02]
    directions = rng.standard_normal((len(origins), 3)) * (1, 1, 0.15)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = brute_force(world, origins, directions)
    assert len(origins) > 800 and np.percentile(expected, 95) > 3 * CELL
    np.testing.assert_allclose(cast_rays(world, origins, directions, 100.0).distance, expected, atol=1e-9)
    short = cast_rays(world, origins, directions, 2.5).distance
    np.testing.assert_allclose(short, np.where(expected <= 2.5, expected, np.inf), atol=1e-9)
    assert np.isinf(cast_rays(world, np.array([[-50.0, 1, 1]]), np.array([[1.0, 0, 0]]), 100.0).distance).all()


def test_rays_along_the_axes_meet_walls(world: World) -> None:
    """Directions with zeros, also from the very height of a box's middle."""
    origins = np.tile([1.2, 1.2, world.height / 2], (4, 1))
    directions = np.array([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    found = cast_rays(world, origins, directions, 30.0).distance
    np.testing.assert_allclose(found, [1.2, 1.2, 1.5, 1.5], atol=1e-9)


def test_points_in_boxes_are_found(world: World) -> None:
    points = np.random.default_rng(1).uniform((-0.1, -0.1, 0), (40.1, 40.1, 3), (8000, 3))
    expected = np.zeros(len(points), bool)
    for number in range(len(world.boxes)):
        expected |= (in_box(world, points, number) < 0).all(1)
    assert 0.03 < expected.mean() < 0.3 and (world.inside(points) == expected).all()
    assert not world.inside(np.array([[500.0, 1.0, 1.0]])).any()


def test_scan_lies_on_surfaces_within_noise(world: World, poses: np.ndarray) -> None:
    for noise in (0.0, 0.02):
        scanner = Scanner(16, 90, noise=noise)
        for pose in poses[::400]:
            scan = scanner.scan(world, pose, 4)
            assert len(scan) > 0.9 * 16 * 90
            away = np.abs(distance(world, transform_points(scan.points.astype(float), pose)))
            assert away.max() < 2e-5 + 5 * noise
            assert noise == 0 or 0.3 * noise < np.sqrt((away**2).mean()) < 1.1 * noise
            direction = scan.points / np.linalg.norm(scan.points, axis=1, keepdims=True)
            expected = scanner.directions.reshape(16, 90, 3)[scan.rings, scan.columns]
            np.testing.assert_allclose(direction, expected, atol=1e-6)


def test_scans_see_walls_in_all_directions(world: World, poses: np.ndarray) -> None:
    """Wherever one stands, points and normals fix all three directions, also along corridors."""
    scanner = Scanner(12, 40, noise=0.0)
    axes = np.vstack([np.zeros((1, 3)), 1e-4 * np.eye(3)])
    for pose in poses[::100]:
        points = transform_points(scanner.scan(world, pose, 0).points.astype(float), pose)
        away = distance(world, (points[:, None] + axes).reshape(-1, 3)).reshape(-1, 4)
        normal = np.clip((away[:, 1:] - away[:, :1]) / 1e-4, -1, 1)
        assert np.linalg.eigvalsh(normal.T @ normal / len(points))[0] > 0.04


def test_the_seed_decides(world: World, poses: np.ndarray) -> None:
    same, other = make_world(40.0, 3), make_world(40.0, 4)
    assert (same.boxes == world.boxes).all() and (same.ways == world.ways).all() and (same.nodes == world.nodes).all()
    assert other.boxes.shape != world.boxes.shape or (other.boxes != world.boxes).any()
    assert (walk(same, 120.0, 1) == poses).all() and not np.allclose(walk(same, 120.0, 2), poses)
    one, again = (SCANNER.scan(world, poses[5], seed).points for seed in (7, 7))
    assert (one == again).all() and one.dtype == np.float32
    assert not np.array_equal(SCANNER.scan(world, poses[5], 8).points, one)
    assert (world_cloud(same, 0.4, 2) == world_cloud(world, 0.4, 2)).all()
    assert not np.array_equal(world_cloud(world, 0.4, 3), world_cloud(world, 0.4, 2))


@pytest.mark.parametrize("size", [25.0, 30.0])
def test_there_is_a_walk_through_every_world(size: float) -> None:
    for seed in range(20):
        made = make_world(size, seed)
        places = np.array([walk(made, 5.0, start)[:, :2, 3] for start in range(3)])
        assert places.shape == (3, 41, 2) and (places > 0).all() and (places < size).all(), f"seed {seed}"


def test_walk_is_smooth_and_stays_clear(world: World, poses: np.ndarray) -> None:
    assert poses.shape == (1000, 4, 4)
    motion = inverse(poses[:-1]) @ poses[1:]
    step = np.linalg.norm(motion[:, :3, 3], axis=1)
    turn = np.array([np.degrees(np.linalg.norm(so3_log(T[:3, :3]))) for T in motion])
    assert step.min() > 0.1 and step.max() < 0.14
    assert turn.max() < 15 and np.abs(np.diff(turn)).max() < 8
    assert np.abs(np.degrees(np.arcsin(poses[:, 2, 0]))).max() > 0.5  # it does pitch
    assert distance(world, poses[:, :3, 3]).min() > 0.3
    assert np.ptp(poses[:, 0, 3]) > 15 and np.ptp(poses[:, 1, 3]) > 15
    ahead = np.diff(poses[:, :2, 3], axis=0) / step[:, None]
    assert np.median((ahead * poses[:-1, :2, 0]).sum(1)) > 0.95  # it looks where it goes


def test_cloud_covers_what_can_be_seen(world: World, poses: np.ndarray) -> None:
    spacing = 0.15
    tiles = list(cloud_tiles(world, spacing))
    cloud = np.concatenate([points for points, _ in tiles])
    normals = np.concatenate([normals for _, normals in tiles])
    assert (cloud == world_cloud(world, spacing)).all() and cloud.dtype == np.float32
    chosen = np.random.default_rng(0).choice(len(cloud), 3000, replace=False)
    some, outward = cloud[chosen].astype(float), normals[chosen].astype(float)
    assert np.abs(distance(world, some)).max() < 1e-4
    assert (distance(world, some + 5e-3 * outward) > 0).mean() > 0.99  # nothing is hidden in a wall
    from scipy.spatial import cKDTree

    tree = cKDTree(cloud)
    for pose in poses[::250]:
        seen = transform_points(Scanner(16, 180, noise=0.0).scan(world, pose, 0).points, pose)
        assert tree.query(seen)[0].max() < 2 * spacing


def test_work_per_scan_does_not_grow_with_the_world() -> None:
    tested = []
    for size in (60.0, 190.0):
        world = make_world(size, 2)
        tested.append(np.mean([SCANNER.scan(world, pose, 0).tested for pose in walk(world, 100.0)[::25]]))
        assert len(world.boxes) > 0.4 * size**2
    assert tested[1] < 1.5 * tested[0] and tested[1] < 25 * SCANNER.rings * SCANNER.columns


def test_impossible_numbers_are_named(world: World) -> None:
    with pytest.raises(SequenceError, match="size: .*25 to 1000 m.* 5"):
        make_world(5.0)
    with pytest.raises(SequenceError, match="length: .*1 m"):
        walk(world, 0.0)
    with pytest.raises(ConfigError, match="rings"):
        Scanner(rings=0)
