# SPDX-License-Identifier: Apache-2.0
"""Scans of a sensor that sees far beyond the map in memory, from starts that are metres and degrees off."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from worlds.cloud import cloud_tiles
from worlds.scanner import Scanner
from worlds.world import World

from ggslam.localization.coverage import CutCells, RecordedCells, coverage_of, reach_of
from ggslam.localization.localizer import Localization, LocalizationStatus, Localizer
from ggslam.localization.scan_alignment import SearchSettings
from ggslam.localization.scan_tracker import ScanTracker, ScanTrackerSettings
from ggslam.localization.scans import LaserScan
from ggslam.localization.surface import NORMAL, SCAN_TARGET, FullSurface, PartialSurface, packed_normals, point_spacing
from ggslam.localization.visits import ScanSights, record_visit
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import se3_exp, separation
from ggslam.submaps.cell_keys import Grid
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import store_cloud
from ggslam.submaps.settings import SubmapSettings

SIZE, MIDDLE = 100.0, np.array([50.0, 50.0, 1.7])
NEAR = SubmapSettings(axes="xy", voxel=0.0, partial_radius=10.0, lookahead=0.0)
SCANNER = Scanner(columns=900, rings=32, lowest_deg=-25, highest_deg=10, farthest=60.0, noise=0.01)


def yard() -> World:
    """Boxes of all sizes, turned anyhow, on level ground under a high ceiling; free around the middle."""
    generator = np.random.default_rng(4)
    boxes = []
    while len(boxes) < 160:
        x, y = generator.uniform(2, SIZE - 2, 2)
        half = generator.uniform(0.2, 3.0, 2)
        if np.hypot(x - 50, y - 50) > 3 + half.max() * 1.5:
            height = generator.uniform(0.5, 6.0)
            boxes.append([x, y, height / 2, *half, height / 2, generator.uniform(0, np.pi)])
    return World(SIZE, 30.0, 4, np.array(boxes), np.zeros((0, 2)), np.zeros((0, 2), np.int64))


def pose(x: float = 0.0, y: float = 0.0, degrees: float = 0.0) -> np.ndarray:
    T = se3_exp(np.array([0, 0, 0, 0, 0, np.radians(degrees)]))
    T[:3, 3] = MIDDLE + [x, y, 0]
    return T


@pytest.fixture(scope="module")
def context() -> NativeContext:
    return NativeContext()


@pytest.fixture(scope="module")
def world() -> World:
    return yard()


@pytest.fixture(scope="module")
def store(world: World, tmp_path_factory: pytest.TempPathFactory) -> Iterator[GridStore]:
    points, normals = (np.concatenate(arrays) for arrays in zip(*cloud_tiles(world, 0.1), strict=True))
    with GridStore.create(tmp_path_factory.mktemp("yard") / "map.grid", NEAR) as made:
        store_cloud(made, points, {NORMAL: packed_normals(normals)})
        yield made


def located(store: GridStore, context: NativeContext, start: np.ndarray, scan: np.ndarray, **settings) -> Localization:
    with PartialSurface(store, SCAN_TARGET, context) as surface:
        tracker = ScanTracker(ScanTrackerSettings(**settings), context, start)
        return Localizer(surface, tracker, start).locate(scan)


def test_what_lies_beyond_the_map_does_not_count(world: World, store: GridStore, context: NativeContext) -> None:
    T = pose(0.4, -0.3, 20)
    scan = SCANNER.scan(world, T, 0).points
    far = np.linalg.norm(scan, axis=1) > 12
    found = located(store, context, T, scan)
    assert found.status is LocalizationStatus.OK and far.mean() > 0.25
    assert found.overlap > 0.9 and 0.3 < found.beyond < 0.95
    moved, turned = separation(found.T_world_sensor, T)
    assert moved < 0.005 and turned < 0.1
    full = Localizer(FullSurface(store, SCAN_TARGET, context), ScanTracker(ScanTrackerSettings(), context, T), T)
    assert full.locate(scan).beyond < 0.02


@pytest.mark.parametrize("off", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("degrees", [0.0, 10.0, -10.0])
def test_starts_that_are_off_converge(
    world: World, store: GridStore, context: NativeContext, off: float, degrees: float
) -> None:
    for number, direction in enumerate((0.3, 1.9, 3.5, 5.1)):
        T = pose(0.2, 0.1, 35)
        scan = SCANNER.scan(world, T, number).points
        start = T @ se3_exp(np.array([0, 0, 0, 0, 0, np.radians(degrees)]))
        start[:2, 3] += off * np.array([np.cos(direction), np.sin(direction)])
        found = located(store, context, start, scan)
        moved, turned = separation(found.T_world_sensor, T)
        assert found.status.is_located and moved < 0.01 and turned < 0.1, (direction, found.reason, moved, turned)


def test_a_start_too_far_off_is_lost_not_somewhere(world: World, store: GridStore, context: NativeContext) -> None:
    T = pose(0.2, 0.1, 35)
    scan = SCANNER.scan(world, T, 0).points
    lost = 0
    for direction in np.arange(0, 6, 0.6).tolist():
        start = T.copy()
        start[:2, 3] += 8 * np.array([np.cos(direction), np.sin(direction)])
        found = located(store, context, start, scan)
        lost += not found.status.is_located
        assert not found.status.is_located or separation(found.T_world_sensor, T)[0] < 0.02
    assert lost >= 5
    start = T.copy()
    start[:2, 3] += [1.5, 0]
    alone = located(store, context, start, scan, search=SearchSettings(reach=0.0))
    assert not alone.status.is_located and "match" in alone.reason


def test_with_nothing_of_the_scan_in_the_map_the_reason_says_so(
    world: World, store: GridStore, context: NativeContext
) -> None:
    scan = SCANNER.scan(world, pose(), 0).points
    found = located(store, context, pose(), scan[np.linalg.norm(scan, axis=1) > 20])
    assert found.status is LocalizationStatus.LOST and found.beyond > 0.99
    assert "0 of" in found.reason and "where the map in memory reaches" in found.reason


def test_cells_that_were_cut_cover_what_lies_in_them_and_recorded_ones_reach_farther(
    world: World, tmp_path_factory: pytest.TempPathFactory, context: NativeContext
) -> None:
    grid = Grid(2.0, "xyz")
    inside = np.array([[0.9, 0.9, 0.9], [-0.9, 0.2, 0.1]])
    assert reach_of(inside, (0, 0, 0), grid) == pytest.approx(np.sqrt(3) * 0.9)
    settings = SubmapSettings(partial_radius=3.0, sensor_range=20.0, radius=1.0)
    cut = coverage_of({(0, 0, 0): 1.5, (1, 0, 0): 1.7, (5, 0, 0): 1.6}, settings, np.zeros(3))
    assert isinstance(cut, CutCells)
    places = np.array([[0, 0, 0], [2.5, 0, 0], [2.5, 2.5, 0], [9, 0, 0], [-1.5, 0, 0]])
    assert cut.covers(places.astype(float)).tolist() == [True, True, False, False, False]
    everything = coverage_of({(0, 0, 0): 1.5, (5, 0, 0): 1.6}, settings)
    assert everything.covers(places.astype(float)).tolist() == [True, True, False, True, False]
    recorded = coverage_of({(0, 0, 0): 15.0}, settings, np.zeros(3))
    assert isinstance(recorded, RecordedCells) and recorded.reach == 14.0
    assert recorded.covers(np.array([[13.9, 0, 0], [0, 14.1, 0]])).tolist() == [True, False]


def test_scans_recorded_from_near_are_located_in_what_they_recorded(
    world: World, tmp_path_factory: pytest.TempPathFactory, context: NativeContext
) -> None:
    """The seed's own numbers: S 2, R 1, R' 10, and points up to 10 m are recorded of a scanner that sees 60 m."""
    poses = np.array([pose(0.3 * n) for n in range(6)])
    scans = [LaserScan(n, 0.1 * n, SCANNER.scan(world, T, n).points) for n, T in enumerate(poses)]
    settings = SubmapSettings(spacing=2.0, radius=1.0, partial_radius=10.0, sensor_range=10.0, lookahead=0.0)
    with GridStore.create(tmp_path_factory.mktemp("own") / "map.grid", settings) as made:
        record_visit(made, iter(scans), poses, ScanSights(), "first")
        for scan, T in zip(scans, poses, strict=True):
            found = located(made, context, T, scan.points)
            assert found.status.is_located and separation(found.T_world_sensor, T)[0] < 0.02, found.reason


def test_the_spacing_of_a_map_is_measured(store: GridStore, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert 0.06 < point_spacing(store) < 0.11  # points are jittered
    with GridStore.create(tmp_path_factory.mktemp("none") / "map.grid", replace(NEAR, spacing=5.0)) as bare:
        assert point_spacing(bare) == 0.0
        x, y = np.meshgrid(np.arange(0, 20, 0.4), np.arange(0, 20, 0.4))
        store_cloud(bare, np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1))
        assert point_spacing(bare) == pytest.approx(0.4, abs=0.01)
