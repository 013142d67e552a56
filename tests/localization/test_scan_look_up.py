# SPDX-License-Identifier: Apache-2.0
"""Scans of which nothing is known are found in a small generated world, and nowhere else."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from worlds.cloud import cloud_tiles
from worlds.plan import make_world
from worlds.pose_graph import read_pose_graph
from worlds.scanner import Scanner
from worlds.walk import walk
from worlds.world import World, cast_rays

from ggslam.errors import ConfigError
from ggslam.formats.raw_points import read_raw_points
from ggslam.localization.level import about_z, floor_height, level_turn
from ggslam.localization.localizer import Localization, LocalizationStatus, Localizer
from ggslam.localization.map_picture import picture_of_store
from ggslam.localization.near import Near, parse_near
from ggslam.localization.scan_look_up import ScanLookUp
from ggslam.localization.scan_maps import scan_places
from ggslam.localization.scan_places import SCAN_PLACES, place_of, recorded_places
from ggslam.localization.scan_tracker import ScanTracker, ScanTrackerSettings, ScanTrackerTuning
from ggslam.localization.scan_views import SECTORS, ViewIndex, view_of
from ggslam.localization.scans import LaserScan
from ggslam.localization.surface import NORMAL, SCAN_TARGET, PartialSurface, packed_normals
from ggslam.localization.visits import ScanSights, record_visit
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import se3_exp, separation, transform_points
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import store_cloud
from ggslam.submaps.settings import SubmapSettings
from ggslam.tracking.scan_points import ScanSettings

GROUND = SubmapSettings(axes="xy", voxel=0.05, partial_radius=10.0, radius=1.5, refresh=0.0)
SCANNER = Scanner(columns=450)


@dataclass(frozen=True)
class Made:
    """A world with poses of a walk every 0.36 m and the scans from them."""

    world: World
    poses: np.ndarray
    scans: list[np.ndarray]

    def query(self, number: int, away: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """A pose `away` metres from one of the walk, in the open, at any azimuth, and a scan from there."""
        rng = np.random.default_rng(seed)
        start = self.poses[number]
        T = np.eye(4)
        T[:3, :3] = about_z(rng.uniform(-np.pi, np.pi))
        T[:3, 3] = start[:3, 3]
        for angle in rng.uniform(-np.pi, np.pi, 100):
            step = np.array([np.cos(angle), np.sin(angle), 0.0])
            if away and cast_rays(self.world, start[None, :3, 3], step[None], 30.0).distance[0] > away + 0.4:
                T[:3, 3] += away * step
                break
        return T, SCANNER.scan(self.world, T, 1000 + seed).points


@pytest.fixture(scope="module")
def made() -> Made:
    world = make_world(40.0, seed=0)
    poses = walk(world, 60.0, seed=0)[::3]
    return Made(world, poses, [SCANNER.scan(world, T, number).points for number, T in enumerate(poses)])


@pytest.fixture(scope="module")
def strange() -> list[np.ndarray]:
    """Scans of another world."""
    world = make_world(40.0, seed=11)
    poses = walk(world, 50.0, seed=3)[::50]
    return [SCANNER.scan(world, T, number).points for number, T in enumerate(poses)]


@pytest.fixture(scope="module")
def recorded(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of the scans."""
    path = tmp_path_factory.mktemp("recorded") / "map.grid"
    items = [LaserScan(number, number * 0.3, points) for number, points in enumerate(made.scans)]
    with GridStore.create(path, GROUND) as store:
        record_visit(store, items, made.poses, ScanSights("xy"), "walk")
    return path


@pytest.fixture(scope="module")
def cloud(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of the world's points."""
    path = tmp_path_factory.mktemp("cloud") / "map.grid"
    points, normals = (np.concatenate(arrays) for arrays in zip(*cloud_tiles(made.world, 0.12), strict=True))
    with GridStore.create(path, replace(GROUND, voxel=0.0)) as store:
        store_cloud(store, points, {NORMAL: packed_normals(normals)})
    return path


def located(
    path: Path, scans: list[np.ndarray], start: np.ndarray | None = None, near: Near | None = None
) -> list[Localization]:
    """Each scan, all by one localizer."""
    context = NativeContext()
    with GridStore.open(path) as store, PartialSurface(store, SCAN_TARGET, context) as surface:
        look_up = ScanLookUp(lambda: scan_places(store, near), store.settings.axes)
        localizer = Localizer(surface, ScanTracker(ScanTrackerSettings(), context, start, look_up), start)
        return [localizer.locate(scan) for scan in scans]


def looked_up(path: Path, scans: list[np.ndarray], near: Near | None = None) -> list[Localization]:
    """Each scan on its own."""
    return [located(path, [scan], near=near)[0] for scan in scans]


@pytest.mark.long("ten scans, each looked up on its own")
@pytest.mark.parametrize("kind", ["recorded", "cloud"])
def test_scans_are_found_where_they_were_made(made: Made, kind: str, request: pytest.FixtureRequest) -> None:
    path = request.getfixturevalue(kind)
    aways = (0.0, 0.5, 1.0, 1.5, 2.0)
    queries = [made.query((13 * i + 5) % len(made.poses), aways[i % 5], i) for i in range(10)]
    results = looked_up(path, [scan for _, scan in queries])
    found = [(T, result) for (T, _), result in zip(queries, results, strict=True) if result.status.is_located]
    assert len(found) >= 9
    for T, result in found:
        moved, turned = separation(result.T_world_sensor, T)
        assert result.status is LocalizationStatus.FOUND and moved < 0.02 and turned < 0.2
    lost = [result.reason for result in results if not result.status.is_located]
    assert all(reason for reason in lost)


@pytest.mark.parametrize("tilt_deg", [6.0, 10.0])
def test_a_tilted_sensor_is_found(made: Made, recorded: Path, tilt_deg: float) -> None:
    T = made.poses[20].copy()
    for turn in ([0, 1, 0], [1, -1, 0]):
        axis = np.radians(tilt_deg) * np.array(turn) / np.linalg.norm(turn)
        mount = se3_exp(np.array([0, 0, 0, *axis]))
        points = SCANNER.scan(made.world, T @ mount, 77).points.astype(float)
        up = (T @ mount)[2, :3]
        assert np.degrees(np.arccos(level_turn(points)[2] @ up)) < 1.0
        (result,) = looked_up(recorded, [points])
        moved, turned = separation(result.T_world_sensor, T @ mount)
        assert result.status is LocalizationStatus.FOUND and moved < 0.03 and turned < 0.3


def test_levelling_leaves_what_stands_upright() -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-9, 9, (2000, 2)), np.full(2000, -1.5)])
    assert np.array_equal(level_turn(ground), np.eye(3))
    assert np.array_equal(level_turn(ground[:20]), np.eye(3)) and np.array_equal(level_turn(ground[:0]), np.eye(3))
    tilted = ground @ se3_exp(np.array([0, 0, 0, np.radians(8), 0, 0]))[:3, :3]
    assert np.abs((tilted @ level_turn(tilted).T)[:, 2] + 1.5).max() < 1e-9


def test_scans_that_see_too_little_are_refused(made: Made, recorded: Path) -> None:
    scan, T = made.scans[20], made.poses[20]
    near = scan[np.linalg.norm(scan, axis=1) < 2.0]
    narrow = scan[np.abs(np.degrees(np.arctan2(scan[:, 1], scan[:, 0]))) < 5]
    for few in (near, narrow):
        (result,) = looked_up(recorded, [few])
        assert result.status is LocalizationStatus.LOST and ("too little" in result.reason or "floor" in result.reason)
    ring = Scanner(rings=1, columns=720, lowest_deg=0, highest_deg=0).scan(made.world, T, 1).points
    (result,) = looked_up(recorded, [ring])
    assert result.status is LocalizationStatus.LOST and "single ring" in result.reason


def test_a_map_of_few_places_believes_only_what_matches_well(made: Made, tmp_path: Path) -> None:
    """What was seen from one place: all scans of the walk look most like it."""
    with GridStore.create(tmp_path / "one.grid", GROUND) as store:
        record_visit(store, [LaserScan(0, 0.0, made.scans[0])], made.poses[:1], ScanSights("xy"), "one")
    results = looked_up(tmp_path / "one.grid", made.scans[:40:3])
    assert results[0].status is LocalizationStatus.FOUND
    for result, T in zip(results, made.poses[:40:3], strict=True):
        if result.status.is_located:
            assert separation(result.T_world_sensor, T)[0] < 0.1 and result.overlap >= 0.5
    with GridStore.open(tmp_path / "one.grid") as store, PartialSurface(store, SCAN_TARGET, NativeContext()) as surface:
        look_up = ScanLookUp(lambda: scan_places(store), "xy", min_overlap=0.9999)
        tracker = ScanTracker(ScanTrackerSettings(), NativeContext(), None, look_up)
        strict = Localizer(surface, tracker, None).locate(made.scans[3])
    assert strict.status is LocalizationStatus.LOST and "100% needed" in strict.reason


@pytest.mark.long("ten scans, each looked up on its own")
@pytest.mark.parametrize("kind", ["recorded", "cloud"])
def test_scans_of_another_place_are_not_found(
    strange: list[np.ndarray], kind: str, request: pytest.FixtureRequest
) -> None:
    for result in looked_up(request.getfixturevalue(kind), strange):
        assert result.status is LocalizationStatus.LOST and result.reason and np.isnan(result.T_world_sensor).all()


def test_a_scan_that_is_carried_away_is_found_again(made: Made, recorded: Path) -> None:
    far = int(np.argmax(np.linalg.norm(made.poses[:, :3, 3] - made.poses[3, :3, 3], axis=1)))
    assert np.linalg.norm(made.poses[far, :3, 3] - made.poses[3, :3, 3]) > 12
    T, scan = made.query(far, 0.3, 77)
    results = located(recorded, [*made.scans[:4], scan, made.scans[far]], made.poses[0])
    statuses = [result.status for result in results]
    assert statuses[:4] == [LocalizationStatus.OK] * 4 and statuses[4] is LocalizationStatus.FOUND
    assert separation(results[4].T_world_sensor, T)[0] < 0.02
    assert results[5].status.is_located and separation(results[5].T_world_sensor, made.poses[far])[0] < 0.02


def test_ever_more_scans_are_passed_over_while_nothing_is_found(made: Made, recorded: Path) -> None:
    asked = []

    class Counted(ScanLookUp):
        def find(self, *arguments):  # noqa: ANN002, ANN202
            asked.append(len(results))
            return None, "nothing"

    context = NativeContext()
    with GridStore.open(recorded) as store, PartialSurface(store, SCAN_TARGET, context) as surface:
        look_up = Counted(lambda: scan_places(store), "xy")
        localizer = Localizer(surface, ScanTracker(ScanTrackerSettings(), context, None, look_up), None)
        results: list[Localization] = []
        for _ in range(24):
            results.append(localizer.locate(made.scans[0]))
    assert asked == [0, 1, 3, 7, 15, 23] and ScanTrackerTuning.max_skipped == 7


def test_only_places_near_a_position_are_looked_at(made: Made, recorded: Path, cloud: Path) -> None:
    T, scan = made.query(40, 0.3, 5)
    x, y, z = T[:3, 3].tolist()
    for path in (recorded, cloud):
        right = located(path, [scan], near=Near((x + 2, y, z), 2.0))[0]
        assert right.status is LocalizationStatus.FOUND and separation(right.T_world_sensor, T)[0] < 0.02
        wrong = located(path, [scan], near=Near((x + 9, y + 9), 2.0))[0]
        assert wrong.status is LocalizationStatus.LOST
    with GridStore.open(recorded) as store:
        near = Near((x, y), 1.0)
        kept = recorded_places(store, near).positions
        every = recorded_places(store).positions
        apart = np.linalg.norm(every[:, :2] - [x, y], axis=1)
        assert 0 < len(kept) == (apart <= 3).sum() < len(every)


def test_near_is_three_or_four_numbers() -> None:
    assert parse_near("1 -2 3") == Near((1.0, -2.0), 3.0)
    assert parse_near("1, 2, 3, 0.5") == Near((1.0, 2.0, 3.0), 0.5)
    for text in ("", "1 2", "1 2 0", "1 2 -3", "a b c", "1 2 3 4 5", "nan 0 1", "0 0 inf"):
        with pytest.raises(ConfigError, match="near"):
            parse_near(text)
    # Without a height: in the plane of the floor, which is x and z of a grid "xz".
    positions = np.array([[0.0, 5.0, 0.0], [0.0, 0.0, 5.0]])
    assert Near((0.0, 0.0), 1.0).allows(positions, "xz").tolist() == [True, False]
    assert Near((0.0, 0.0), 1.0).allows(positions, "xyz").tolist() == [False, True]
    assert Near((0.0, 0.0, 0.0), 1.0).allows(positions, "xz").tolist() == [False, False]


def test_a_turn_is_told_by_the_views(made: Made) -> None:
    upright = [T[:3, :3] for T in made.poses]
    codes = np.array([view_of(p @ R.T).code for p, R in zip(made.scans, upright, strict=True)])
    index = ViewIndex(codes)
    for number, angle in ((10, 0.3), (60, -2.0), (100, 3.0)):
        turned = view_of(made.scans[number] @ upright[number].T @ about_z(-angle).T)
        numbers, likeness, _, turns = index.query(turned.code[None])
        assert numbers[0] == number and likeness[0] > 0.7
        off = abs((turns[0] - angle + np.pi) % (2 * np.pi) - np.pi)
        assert off < 0.3 * 2 * np.pi / SECTORS
    numbers, likeness, _, turns = index.query(codes[7:8])
    assert numbers[0] == 7 and likeness[0] == pytest.approx(1.0, abs=1e-4) and turns[0] == pytest.approx(0, abs=1e-6)


def test_the_floor_is_found_below_the_sensor(made: Made) -> None:
    for T, points in list(zip(made.poses, made.scans, strict=True))[::20]:
        assert floor_height(points @ T[:3, :3].T) == pytest.approx(-T[2, 3], abs=0.05)
    assert floor_height(np.zeros((3, 3))) is None


def test_places_are_kept_with_the_cells(made: Made, recorded: Path, tmp_path: Path) -> None:
    with GridStore.open(recorded) as store:
        cells = [key for key in store.cells() if SCAN_PLACES in store.cell(key).parts]
        assert len(cells) > 15 and all(store.cell(key).parts[SCAN_PLACES].count for key in cells)
        places = recorded_places(store)
    apart = np.linalg.norm(places.positions[:, None] - made.poses[None, :, :3, 3], axis=2).min(1)
    assert len(places) > 60 and apart.max() < 1e-9
    path = tmp_path / "map.grid"
    with GridStore.create(path, GROUND) as store:
        items = [LaserScan(number, float(number), points) for number, points in enumerate(made.scans[:40])]
        record_visit(store, items, made.poses[:40], ScanSights("xy"), "first")
        once = len(recorded_places(store))
        record_visit(store, items, made.poses[:40], ScanSights("xy"), "second", at=1e5)
        assert len(recorded_places(store)) == 2 * once
    parts = sorted((path / "cells").rglob(SCAN_PLACES))
    parts[0].write_bytes(parts[0].read_bytes()[:-1])
    with GridStore.open(path) as store:
        torn = recorded_places(store)
        assert len(torn) < 2 * once and len(torn.damage) == 1 and SCAN_PLACES in torn.damage[0]


def test_a_map_whose_y_points_down_is_looked_at_upright(made: Made, tmp_path: Path) -> None:
    points = np.concatenate([p for p, _ in cloud_tiles(made.world, 0.15)])
    turned = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # level z becomes -y
    T, scan = made.query(30, 0.3, 9)
    down = np.eye(4)
    down[:3, :3] = turned
    with GridStore.create(tmp_path / "map.grid", replace(GROUND, axes="xz", voxel=0.0)) as store:
        store_cloud(store, points @ turned.T)
        picture = picture_of_store(store)
        first = next(picture.guesses(scan.astype(float), floor_height(scan), 10, 1.5))
    moved, angle = separation(first, down @ T)
    assert moved < 0.6 and angle < 6
    place = place_of(scan, down @ T, "xz")
    assert place is not None and place.floor == pytest.approx(-T[2, 3], abs=0.05)


def test_a_submap_of_a_street_is_found_in_a_map_of_the_others(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "clouds" / "kitti_07_submaps"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    poses = list(read_pose_graph(folder / "graph.txt").values())
    clouds = [read_raw_points(folder / f"{number:06}" / "points.bin")[:, :3].astype(float) for number in range(5)]
    outdoors = SubmapSettings(spacing=10.0, axes="xy", voxel=0.0, partial_radius=60.0, sensor_range=80.0)
    turn = np.eye(4)
    turn[:3, :3] = about_z(2.0)
    scan = transform_points(clouds[2], np.linalg.inv(turn)).astype(np.float32)  # 5.5 m from the nearest other
    context = NativeContext()
    tracker = ScanTrackerSettings(scan=ScanSettings(voxel=0.5, nearest=2.5), sigma=0.05)
    with GridStore.create(tmp_path / "map.grid", outdoors) as store:
        store_cloud(store, np.concatenate([transform_points(clouds[n], poses[n]) for n in (0, 1, 3, 4)]))
        with PartialSurface(store, replace(SCAN_TARGET, voxel=0.4), context) as surface:
            look_up = ScanLookUp(lambda: scan_places(store), "xy")
            found = Localizer(surface, ScanTracker(tracker, context, None, look_up), None).locate(scan)
    assert found.status is LocalizationStatus.FOUND, found.reason
    moved, turned = separation(found.T_world_sensor, poses[2] @ turn)
    assert moved < 0.05 and turned < 0.3
