# SPDX-License-Identifier: Apache-2.0
"""Scans in corridors: what walls do not tell is not said to be known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds.cloud import cloud_tiles
from worlds.scanner import Scanner
from worlds.world import World

from ggslam.localization.localizer import Localization, LocalizationStatus, Localizer
from ggslam.localization.scan_tracker import ScanTracker, ScanTrackerSettings
from ggslam.localization.surface import NORMAL, SCAN_TARGET, PartialSurface, packed_normals
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import se3_exp, separation
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import store_cloud
from ggslam.submaps.settings import SubmapSettings

WALLS = [[50, 47.9, 1.5, 49.9, 0.1, 1.5, 0], [50, 52.1, 1.5, 49.9, 0.1, 1.5, 0]]
NEAR = SubmapSettings(axes="xyz", voxel=0.0, partial_radius=10.0, lookahead=0.0)
SCANNER = Scanner()
CONTEXT = NativeContext()


def corridor(boxes: list[list[float]]) -> World:
    """100 m long, 4 m wide, 3 m high, with boxes in it."""
    return World(100.0, 3.0, 0, np.array(WALLS + boxes), np.zeros((2, 2)), np.zeros((1, 2), np.int64))


def store_of(world: World, path: Path) -> GridStore:
    points, normals = (np.concatenate(arrays) for arrays in zip(*cloud_tiles(world, 0.1), strict=True))
    inside = (np.abs(points[:, 1] - 50) < 3) & (np.abs(points[:, 0] - 50) < 30)
    store = GridStore.create(path / "map.grid", NEAR)
    store_cloud(store, points[inside], {NORMAL: packed_normals(normals[inside])})
    return store


def pose(x: float, yaw: float = 0.0) -> np.ndarray:
    T = se3_exp(np.array([0, 0, 0, 0, 0, yaw]))
    T[:3, 3] = [x, 50.2, 1.2]
    return T


def located(store: GridStore, start: np.ndarray, scan: np.ndarray) -> Localization:
    with PartialSurface(store, SCAN_TARGET, CONTEXT) as surface:
        return Localizer(surface, ScanTracker(ScanTrackerSettings(), CONTEXT, start), start).locate(scan)


def started(T: np.ndarray, off: float, degrees: float) -> np.ndarray:
    start = T @ se3_exp(np.array([0, 0, 0, 0, 0, np.radians(degrees)]))
    start[0, 3] += off
    return start


def test_along_a_plain_corridor_no_place_is_known(tmp_path: Path) -> None:
    world = corridor([])
    with store_of(world, tmp_path) as store:
        for number, off in enumerate((0.0, 0.5, -1.0, 2.0)):
            T = pose(46 + 2.3 * number, number)
            found = located(store, started(T, off, 5 * off), SCANNER.scan(world, T, number).points)
            assert found.status is LocalizationStatus.DEGENERATE, (off, found.status)
            assert "motion along (1.00" in found.reason.replace("-", "") and "not seen" in found.reason
            away = found.T_world_sensor[:3, 3] - T[:3, 3]
            assert np.abs(away[1:]).max() < 0.01  # what is seen is right


def test_a_ride_along_a_plain_corridor_stays_degenerate(tmp_path: Path) -> None:
    world = corridor([])
    poses = [pose(45 + 0.3 * n) for n in range(8)]
    with store_of(world, tmp_path) as store, PartialSurface(store, SCAN_TARGET, CONTEXT) as surface:
        localizer = Localizer(surface, ScanTracker(ScanTrackerSettings(), CONTEXT, poses[0]), poses[0])
        found = [localizer.locate(SCANNER.scan(world, T, n).points).status for n, T in enumerate(poses)]
    assert found == [LocalizationStatus.DEGENERATE] * len(poses)


def test_along_a_corridor_with_niches_the_place_is_right(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    niches = [
        [x, 51.8, generator.uniform(0.5, 1.5), generator.uniform(0.1, 0.5), generator.uniform(0.1, 0.3), 1.0, 0]
        for x in generator.uniform(3, 97, 25).tolist()
    ]
    world, right = corridor(niches), 0
    with store_of(world, tmp_path) as store:
        for number, off in enumerate((0.5, -0.5, 1.0, -1.0, 2.0, -2.0, 3.0, -3.0)):
            T = pose(42 + 2.1 * number, number)
            found = located(store, started(T, off, 3 * off), SCANNER.scan(world, T, number).points)
            moved, turned = separation(found.T_world_sensor, T)
            right += moved < 0.02 and turned < 0.2
            assert found.status is not LocalizationStatus.OK or (moved < 0.02 and turned < 0.2), (off, moved)
    assert right >= 6


@pytest.mark.parametrize(("off", "status"), [(0.0, LocalizationStatus.OK), (2.4, LocalizationStatus.DEGENERATE)])
def test_between_pillars_at_equal_distances_the_start_decides(
    tmp_path: Path, off: float, status: LocalizationStatus
) -> None:
    pillars = [[x, y, 1.5, 0.2, 0.2, 1.5, 0] for x in range(5, 96, 5) for y in (48.2, 51.8)]
    world, T = corridor(pillars), pose(48.3)
    with store_of(world, tmp_path) as store:
        found = located(store, started(T, off, 0.0), SCANNER.scan(world, T, 1).points)
    assert found.status is status, found.reason
    along = (found.T_world_sensor[0, 3] - T[0, 3]) / 5
    assert abs(along - round(along)) < 0.004 and ("matches as well" in found.reason) == (off > 0)
