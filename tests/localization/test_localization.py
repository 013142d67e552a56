# SPDX-License-Identifier: Apache-2.0
"""Locating scans in a small generated world, and frames of a generated room, in stored maps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds.cloud import cloud_tiles
from worlds.plan import make_world
from worlds.scanner import Scanner
from worlds.walk import walk

from ggslam.jobs.submaps.stores import INDOORS
from ggslam.localization.frames import FrameTracker
from ggslam.localization.localizer import Localization, LocalizationStatus, Localizer
from ggslam.localization.places import StoredPlaces
from ggslam.localization.scan_tracker import ScanTracker, ScanTrackerSettings
from ggslam.localization.scans import LaserScan
from ggslam.localization.surface import (
    NORMAL,
    FullSurface,
    PartialSurface,
    load_surface,
    packed_normals,
    surface_normals,
)
from ggslam.localization.visits import FrameSights, ScanSights, record_visit
from ggslam.native.loader import NativeContext
from ggslam.sequences import open_sequence
from ggslam.submaps.cell_points import POINTS
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import store_cloud
from ggslam.submaps.settings import SubmapSettings
from ggslam.tracking.settings import TargetSettings, TrackerSettings

GROUND = SubmapSettings(axes="xy", voxel=0.0, partial_radius=8.0, cache_megabytes=20)
TARGET = TargetSettings(voxel=0.15)


@pytest.fixture(scope="module")
def context() -> NativeContext:
    return NativeContext()


@pytest.fixture(scope="module")
def world() -> tuple[np.ndarray, list[np.ndarray], np.ndarray, np.ndarray]:
    """Poses of a walk, scans from them, points and normals of a world of 30 x 30 m."""
    made = make_world(30.0, seed=0)
    poses = walk(made, 6.0, seed=0)
    scanner = Scanner(columns=450)
    scans = [scanner.scan(made, T, seed).points for seed, T in enumerate(poses)]
    points, normals = (np.concatenate(arrays) for arrays in zip(*cloud_tiles(made, 0.1), strict=True))
    return poses, scans, points, normals


@pytest.fixture(scope="module")
def store(world, tmp_path_factory: pytest.TempPathFactory) -> Iterator[GridStore]:
    _, _, points, normals = world
    with GridStore.create(tmp_path_factory.mktemp("world") / "map.grid", GROUND) as made:
        store_cloud(made, points, {NORMAL: packed_normals(normals)})
        yield made


def located(surface, context: NativeContext, poses: np.ndarray, scans: list[np.ndarray]) -> list[Localization]:
    localizer = Localizer(surface, ScanTracker(ScanTrackerSettings(), context, poses[0]), poses[0])
    results = [localizer.locate(scan) for scan in scans]
    surface.close()
    return results


def rmse(results: list[Localization], poses: np.ndarray) -> float:
    errors = [np.linalg.norm(r.T_world_sensor[:3, 3] - T[:3, 3]) for r, T in zip(results, poses, strict=True)]
    return float(np.sqrt(np.mean(np.square(errors))))


def test_a_partial_map_locates_as_well_as_the_full_one(world, store: GridStore, context: NativeContext) -> None:
    poses, scans, points, _ = world
    partial = located(PartialSurface(store, TARGET, context), context, poses, scans)
    full = located(FullSurface(store, TARGET, context), context, poses, scans)
    assert all(r.status.is_located for r in partial + full)
    assert rmse(partial, poses) < 0.02 and rmse(full, poses) < 0.02
    assert all(r.map_points == len(points) for r in full)
    assert all(0 < r.map_points < 0.5 * len(points) for r in partial)
    assert 2 <= sum(r.map_changed for r in partial) < len(partial) / 3  # when it enters a cell, not at every scan


@pytest.fixture(scope="module")
def room_store(room: Path, context: NativeContext, tmp_path_factory: pytest.TempPathFactory) -> Iterator[GridStore]:
    """The first 16 frames of the room, recorded with their true poses."""
    frames = open_sequence(room, stop=16)
    settings = replace(INDOORS, radius=2.0)
    with GridStore.create(tmp_path_factory.mktemp("room") / "room.grid", settings) as made:
        assert record_visit(made, frames.stream(), frames.ground_truth, FrameSights(frames.camera, context), "first")
        yield made


@pytest.mark.parametrize("with_start", [True, False])
def test_frames_are_located_with_and_without_a_start_pose(
    room: Path, room_store: GridStore, context: NativeContext, with_start: bool
) -> None:
    frames = open_sequence(room, start=10)
    start = frames.ground_truth[0] if with_start else None
    front_end = FrameTracker(frames.camera, TrackerSettings(), context, start, StoredPlaces(room_store, frames.camera))
    with PartialSurface(room_store, TargetSettings(), context) as surface:
        localizer = Localizer(surface, front_end, start)
        results = [localizer.locate(frame) for frame in frames.stream()]
    assert all(r.status.is_located for r in results)
    assert (results[0].status is LocalizationStatus.FOUND) != with_start
    assert rmse(results, frames.ground_truth) < 0.01


def test_where_the_map_has_nothing_is_a_status_not_an_error(world, store: GridStore, context: NativeContext) -> None:
    poses, scans, _, _ = world
    away = poses[0].copy()
    away[:3, 3] += [500, 0, 0]
    with PartialSurface(store, TARGET, context) as surface:
        localizer = Localizer(surface, ScanTracker(ScanTrackerSettings(), context, away), away)
        found = localizer.locate(scans[0])
        assert found.status is LocalizationStatus.OUTSIDE and not found.status.is_located and found.map_points == 0
        assert np.array_equal(found.T_world_sensor, away) and "nothing around (5" in found.reason


def test_a_scan_that_does_not_fit_is_lost_and_the_next_one_goes_on(
    world, store: GridStore, context: NativeContext
) -> None:
    poses, scans, _, _ = world
    with PartialSurface(store, TARGET, context) as surface:
        localizer = Localizer(surface, ScanTracker(ScanTrackerSettings(), context, poses[0]), poses[0])
        nonsense = np.random.default_rng(0).uniform(-5, 5, (3000, 3)).astype(np.float32)
        statuses = [localizer.locate(scan).status for scan in (scans[0], nonsense, scans[0][:0], scans[1])]
    assert [s.value for s in statuses] == ["ok", "lost", "lost", "ok"]


def test_normals_are_made_up_where_the_map_has_none(world, tmp_path: Path, context: NativeContext) -> None:
    poses, scans, points, normals = world
    near = np.linalg.norm(points[:, :2] - poses[0, :2, 3], axis=1) < 8
    with GridStore.create(tmp_path / "map.grid", GROUND) as bare:
        store_cloud(bare, points[near])
        key = bare.key_of(poses[0, :3, 3])
        assert not load_surface(bare, key)[2]
        for surface in (PartialSurface(bare, TARGET, context), FullSurface(bare, TARGET, context)):
            results = located(surface, context, poses[:12], scans[:12])
            assert all(r.status.is_located for r in results) and rmse(results, poses[:12]) < 0.03
    flat = points[near & (points[:, 2] == 0)][:2000]
    assert (np.abs(surface_normals(flat)[:, 2]) > 0.999).mean() > 0.95


def test_a_target_on_the_way_is_what_it_is_when_made_there(world, store: GridStore, context: NativeContext) -> None:
    with PartialSurface(store, TARGET, context) as walking:
        assert walking.move_to(np.array([10.0, 15, 1.3])) and not walking.move_to(np.array([10.1, 15, 1.3]))
        for x in np.arange(11.0, 22.0, 2.0):
            before = walking.target
            assert walking.move_to(np.array([x, 15, 1.3])) and walking.target is not before
            with PartialSurface(store, TARGET, context) as fresh:
                assert fresh.move_to(np.array([x, 15, 1.3])) and fresh.points == walking.points > 0
            for level in (0, 1):
                one, other = (t.target.voxels(level) for t in (walking, fresh))  # type: ignore[union-attr]
                assert len(one["means"]) and all(one[name].tobytes() == other[name].tobytes() for name in one)


def test_a_cell_that_was_written_anew_is_aligned_to_anew(
    world, store: GridStore, tmp_path: Path, context: NativeContext
) -> None:
    _, _, points, normals = world
    near = np.linalg.norm(points[:, :2] - 10, axis=1) < 4
    with GridStore.create(tmp_path / "map.grid", replace(GROUND, partial_radius=3.0, lookahead=0.0)) as own:
        store_cloud(own, points[near], {NORMAL: packed_normals(normals[near])})
        with PartialSurface(own, TARGET, context) as surface:
            surface.move_to(np.array([10.0, 10, 1]))
            count = surface.points
            store_cloud(own, points[near][::2], {NORMAL: packed_normals(normals[near][::2])})
            assert surface.move_to(np.array([12.0, 10, 1])) and surface.points < 0.7 * count


def test_visits_refresh_what_they_look_at_after_the_time(
    room: Path, room_store: GridStore, context: NativeContext
) -> None:
    frames = open_sequence(room, stop=4)
    sights = FrameSights(frames.camera, context)
    known = {key: room_store.cell(key) for key in room_store.cells()}
    latest = max(cell.recorded_at for cell in known.values())  # type: ignore[type-var]
    assert record_visit(room_store, frames.stream(), frames.ground_truth, sights, "soon", latest) == []
    written = record_visit(room_store, frames.stream(), frames.ground_truth, sights, "later", latest + 301)
    assert written and set(written) <= set(known)
    for key in written:
        before, after = known[key], room_store.cell(key)
        assert after.visit == "later" and after.parts[POINTS].count > 0.8 * before.parts[POINTS].count
        assert after.parts["places.npz"].count > before.parts["places.npz"].count
    changes = room_store.changed_since("later")
    assert [c.key for c in changes] == sorted(written)
    assert all(c.changed is not None and c.changed < 0.05 and not c.added for c in changes)


def test_scans_are_recorded_and_located_again(world, tmp_path: Path, context: NativeContext) -> None:
    poses, scans, _, _ = world
    items = [LaserScan(i, 0.1 * i, scan) for i, scan in enumerate(scans)]
    settings = replace(GROUND, voxel=0.1, sensor_range=20.0, radius=1.5)
    with GridStore.create(tmp_path / "map.grid", settings) as made:
        written = record_visit(made, items, poses, ScanSights(), "first")
        assert len(written) == len(set(written)) >= 3
        results = located(PartialSurface(made, TARGET, context), context, poses, scans)
    assert all(r.status.is_located for r in results) and rmse(results, poses) < 0.03


def test_frames_outside_of_the_map_are_looked_up(room: Path, room_store: GridStore, context: NativeContext) -> None:
    frames = open_sequence(room, start=10, stop=12)
    away = frames.ground_truth[0].copy()
    away[:3, 3] += 300
    for places, status in (
        (None, LocalizationStatus.OUTSIDE),
        (StoredPlaces(room_store, frames.camera), LocalizationStatus.FOUND),
    ):
        front_end = FrameTracker(frames.camera, TrackerSettings(), context, away, places)
        with PartialSurface(room_store, TargetSettings(), context) as surface:
            localizer = Localizer(surface, front_end, away)
            results = [localizer.locate(frame) for frame in frames.stream()]
        assert results[0].status is status
    assert rmse(results, frames.ground_truth) < 0.01


def test_the_origin_follows_the_sensor(world, tmp_path: Path, context: NativeContext) -> None:
    """Where the walk comes to be a kilometre from the target's origin, another is chosen, and nothing else changes."""
    poses, scans, points, normals = world
    poses, scans = poses[:20], scans[:20]
    found, origins = [], []
    way = poses[-1, :3, 3] - poses[0, :3, 3]
    axis = int(np.abs(way).argmax())
    border = np.eye(3)[axis] * (np.sign(way[axis]) * 1000.0 - poses[10, axis, 3])
    for offset in (np.zeros(3), 2 * np.round(border / 2)):  # whole cells
        moved = poses.copy()
        moved[:, :3, 3] += offset
        with GridStore.create(tmp_path / f"{abs(offset).max():.0f}.grid", GROUND) as own:
            store_cloud(own, points + offset, {NORMAL: packed_normals(normals)})
            surface = PartialSurface(own, TARGET, context)
            localizer = Localizer(surface, ScanTracker(ScanTrackerSettings(), context, moved[0]), moved[0])
            for scan in scans:
                result = localizer.locate(scan)
                assert result.status.is_located
                found.append(result.T_world_sensor[:3, 3] - offset)
                origins.append(surface.target.origin)  # type: ignore[union-attr]
            surface.close()
    near, far = np.reshape(found, (2, len(poses), 3))
    assert not np.any(origins[: len(poses)]) and len(np.unique(origins[len(poses) :], axis=0)) == 2
    assert np.abs(near - far).max() < 2e-3 and np.abs(far - poses[:, :3, 3]).max() < 0.02
