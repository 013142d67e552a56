# SPDX-License-Identifier: Apache-2.0
"""Registration of laser scans and rooms from starts that are far off, measured against exact motions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds.plan import make_world
from worlds.scanner import Scanner
from worlds.walk import walk

from ggslam.formats.point_cloud import read_point_cloud
from ggslam.geometry.clouds import overlap
from ggslam.geometry.coarse_to_fine import TargetSurface, point_spacing, register_coarse_to_fine
from ggslam.geometry.icp import register
from ggslam.geometry.surface_distances import summary_of, surface_distances
from ggslam.geometry.thinning import thinned_points, thinned_rows
from ggslam.scene.poses import inverse, se3_exp, transform_points, translation, turning_angle

UTM = np.array([463000.0, 5427000.0, 300.0])


def errors(T_true: np.ndarray, T_found: np.ndarray, source: np.ndarray) -> tuple[float, float]:
    """Millimetres at the middle of the source, and degrees."""
    middle, E = source.mean(0), inverse(T_true) @ T_found
    off = transform_points(middle[None], E)[0] - middle
    return 1e3 * float(np.linalg.norm(off)), float(np.degrees(turning_angle(E, np.eye(4))))


@pytest.fixture(scope="module")
def scans() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Pairs of scans of a generated world, 16 rings each, and T_target_source: 0.4 m and 3 degrees."""
    world = make_world(60.0, seed=1)
    poses, pairs = walk(world, 4.0, seed=1), []
    for number in (0, 10, 25):
        one, other = poses[number], poses[number + 2]
        source, target = (Scanner().scan(world, T, seed).points.astype(float) for seed, T in ((1, one), (2, other)))
        T_wrong = se3_exp(np.array([0.3, -0.2, 0, 0, 0, 0.05]))
        pairs.append((transform_points(source, T_wrong), target, inverse(other) @ one @ inverse(T_wrong)))
    return pairs


def test_scans_are_registered_to_millimetres(scans: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
    for source, target, T in scans:
        assert point_spacing(target, 0.05) > 1.5 * 0.05  # sparse
        millimetres, degrees = errors(T, register_coarse_to_fine(source, target).T_target_source, source)
        assert millimetres < 4 and degrees < 0.15, (millimetres, degrees)


def test_the_place_in_the_world_does_not_matter(scans: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
    source, target, _ = scans[0]
    near, far = register_coarse_to_fine(source, target), register_coarse_to_fine(source + UTM, target + UTM)
    back = translation(-UTM) @ far.T_target_source @ translation(UTM)
    millimetres, degrees = errors(near.T_target_source, back, source)
    assert millimetres < 0.01 and degrees < 1e-3
    assert far.turned_deg == pytest.approx(near.turned_deg, abs=1e-4) and near.turned_deg > 2
    assert far.overlap.fitness == near.overlap.fitness
    fine = register(target + UTM, target + UTM + (0.004, 0.002, 0.01))
    assert np.allclose(transform_points(target + UTM, fine.T_target_source) - target - UTM, (0.004, 0.002, 0.01), 1e-3)


def test_surface_distances_see_what_shares_of_points_do_not() -> None:
    """Scans of a wavy wall, half a metre apart, each with the same dense patch below the sensor: more points have a
    partner at the wrong pose, the surface is nearer at the right one."""
    rng = np.random.default_rng(0)

    def scan(x: float) -> np.ndarray:
        under = np.concatenate([rng.normal(0, 0.1, (9000, 2)), np.full((9000, 1), -1.0)], 1)  # moves with the sensor
        along, up = rng.uniform(-8, 8, 3000), rng.uniform(-1, 1, 3000)
        wall = np.stack([along - x, 2 + 0.5 * np.sin(3 * along), up], 1)
        return np.concatenate([under, wall])

    source, target = scan(0.0), scan(0.5)
    right = translation(np.array([-0.5, 0, 0]))
    shares = [overlap(source, target, 0.05, T).fitness for T in (np.eye(4), right)]
    assert shares[0] > shares[1] + 0.3
    found = [summary_of(surface_distances(source, target, 0.05, 0.1, T)) for T in (np.eye(4), right)]
    assert found[1].median_m < 0.3 * found[0].median_m


def test_a_dense_room_is_registered_as_by_plain_icp() -> None:
    rng = np.random.default_rng(0)

    def room(seed: int) -> np.ndarray:
        flat = np.random.default_rng(seed).uniform(0, 2, (3, 4000, 2))
        walls = [np.insert(flat[axis], axis, 0.0, axis=1) for axis in range(3)]
        walls[0][:, 0] += 0.3 * (walls[0][:, 1] > 1)
        return np.concatenate(walls)

    target, source = room(1), room(2)
    assert TargetSurface.of(target, 0.05).voxel is None
    T = se3_exp(np.array([0.06, -0.05, 0.08, 0.03, -0.04, 0.05]))
    plain = register(transform_points(source, inverse(T)), target)
    found = register_coarse_to_fine(transform_points(source, inverse(T)), target)
    assert np.allclose(plain.T_target_source, found.T_target_source, atol=1e-6)
    far = se3_exp(np.array([0.5, -0.4, 0.3, *(0.15 * rng.normal(size=3))]))
    found = register_coarse_to_fine(transform_points(source, inverse(far)), target)
    millimetres, degrees = errors(far, found.T_target_source, source)
    assert millimetres < 3 and degrees < 0.2


def test_thinned_clouds_have_one_point_per_voxel() -> None:
    points = np.random.default_rng(0).uniform(0, 1, (5000, 3))
    points[0] = 0
    for offset in (np.zeros(3), UTM):
        means, rows = thinned_points(points + offset, 0.25), thinned_rows(points + offset, 0.25)
        assert len(means) == len(rows) == 64 and rows[0] == 0
        assert np.abs(np.sort(means[:, 0] - offset[0]) - np.repeat(np.arange(4) * 0.25 + 0.125, 16)).max() < 0.03
    wide = np.array([[0.0, 0, 0], [1e6, 1e6, 1e6], [1e-9, 0, 0]])
    assert len(thinned_points(wide, 1e-3)) == 2  # more voxels than double precision can number


def test_two_scans_of_a_street(shared_data: Path) -> None:
    pair = shared_data / "clouds" / "scan_pair"
    source, target = (read_point_cloud(pair / f"{name}.ply").points for name in ("source", "target"))
    T = np.loadtxt(pair / "T_target_source.txt")
    for distance in (0.05, 0.5):
        found = register_coarse_to_fine(source, target, distance)
        millimetres, degrees = errors(T, found.T_target_source, source)
        assert millimetres < 15 and degrees < 0.4, (millimetres, degrees)
        assert found.moved_m == pytest.approx(0.492, abs=0.01) and found.turned_deg == pytest.approx(0.72, abs=0.1)
