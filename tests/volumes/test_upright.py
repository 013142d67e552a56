# SPDX-License-Identifier: Apache-2.0
"""The up direction and the floor."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from distance_scenes import block_range, box, box_room, rotation, union, write_scene

from ggslam.scene.gaussian_map import GaussianMap
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.map_upright import upright_of
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.upright import estimate_up

TURN = rotation((1, 0.3, -0.2), 100)
UP = TURN @ np.array([0, 0, 1.0])


def cameras(up: np.ndarray, tilt_degrees: float, spread_degrees: float, n: int = 40) -> np.ndarray:
    """Poses whose -y axes scatter around a direction `tilt_degrees` from up."""
    rng = np.random.default_rng(0)
    side = np.cross(up, [0.3, 0.5, 0.7])
    held = rotation(tuple(side), tilt_degrees) @ up
    poses = np.tile(np.eye(4), (n, 1, 1))
    for pose in poses:
        minus_y = rotation(tuple(rng.normal(size=3)), spread_degrees * rng.random()) @ held
        x = np.cross(minus_y, rng.normal(size=3))
        x /= np.linalg.norm(x)
        pose[:3, :3] = np.stack([x, -minus_y, np.cross(x, -minus_y)], 1)
    return poses


@pytest.fixture(scope="module")
def surface() -> tuple[np.ndarray, np.ndarray]:
    """A turned room whose floor is at -1.2 and which has a table, top at -0.4, and a ceiling."""
    tsdf = TsdfMap(TsdfSettings(voxel=0.05))
    room = box_room((-1.5, -1.2, -1.2), (1.5, 1.2, 1.2), TURN)
    table = box((-0.6, -0.5, -1.2), (0.6, 0.5, -0.4))
    scene = union(room, lambda p: table(p @ TURN))
    write_scene(tsdf, scene, block_range((-2, -2, -2), (2, 2, 2), 0.05))
    field = DistanceField(tsdf)
    field.update()
    return field.surface()


def test_up_is_found_from_cameras_that_look_down(surface: tuple[np.ndarray, np.ndarray]) -> None:
    found = estimate_up(cameras(UP, 20, 15), *surface)
    assert np.degrees(np.arccos(min(1, found.up @ UP))) < 0.5
    assert found.support > 0.2 and 10 < found.from_cameras_degrees < 30
    assert found.floor == pytest.approx(-1.2, abs=0.03)


def test_walls_are_not_taken_for_the_floor(surface: tuple[np.ndarray, np.ndarray]) -> None:
    points, normals = surface
    walls = np.abs(normals @ UP) < 0.5
    found = estimate_up(cameras(UP, 10, 10), points[walls], normals[walls])
    assert found.support == 0 and found.from_cameras_degrees == pytest.approx(0, abs=1e-3) and found.floor is None
    assert np.degrees(np.arccos(found.up @ UP)) == pytest.approx(10, abs=3)


def test_without_surfaces_the_cameras_decide() -> None:
    found = estimate_up(np.eye(4)[None], np.empty((0, 3)), np.empty((0, 3)))
    assert np.array_equal(found.up, [0, -1, 0]) and found.support == 0 and found.floor is None
    two = np.stack([np.eye(4), np.diag([-1.0, -1, 1, 1])])  # upside down and not: no mean
    assert np.array_equal(estimate_up(two, np.zeros((5, 3)), np.zeros((5, 3))).up, [0, -1, 0])


@pytest.mark.parametrize("samples", [None, 4000])
def test_up_of_a_map_whose_gaussians_lie_on_planes_and_are_turned_anyhow(samples: int | None) -> None:
    """Training leaves the axes of single Gaussians anywhere; the planes that neighbours lie in tell all the same."""
    random = np.random.default_rng(0)
    up = np.array([0.25, -0.95, 0.2]) / np.linalg.norm([0.25, -0.95, 0.2])
    across = np.linalg.svd(up[None])[2][1:]
    floor = random.uniform(-2, 2, (6000, 2)) @ across - 1.2 * up
    wall = random.uniform(-1.2, 1, (3000, 1)) * up + random.uniform(-2, 2, (3000, 1)) * across[0] + 2 * across[1]
    points = np.concatenate([floor, wall]) + random.normal(0, 0.004, (9000, 3))
    gaussians = GaussianMap(with_moments=False)
    anyhow = [torch.from_numpy(random.normal(size=(9000, width))).float() for width in (4, 3)]
    gaussians.insert(torch.from_numpy(points).float(), anyhow[0], anyhow[1] - 4, 2.0, torch.full((9000, 3), 0.5))
    found = upright_of(gaussians, np.tile(np.eye(4), (5, 1, 1)), samples)
    assert np.degrees(np.arccos(min(1.0, float(found.up @ up)))) < 0.5 and found.support > 0.3
    assert found.floor == pytest.approx(-1.2, abs=0.01)
