#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""One case of `bench_submaps.py`, in a process of its own so that its peak memory is its own; prints JSON.

python scripts/benchmarks/submap_runs.py world FOLDER --size 100 --scans 150
python scripts/benchmarks/submap_runs.py room FOLDER --recording data/redkitchen --stop 150
python scripts/benchmarks/submap_runs.py locate STORE SEQUENCE --full
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
from kdtree_gicp import TreeSurface, TreeTracker

from ggslam.jobs.localize.report import LocalizationReport
from ggslam.jobs.submaps.stores import INDOORS
from ggslam.localization.frames import FrameTracker
from ggslam.localization.localizer import Localization, LocalizationStatus, Localizer
from ggslam.localization.near import Near
from ggslam.localization.reach import AUTO, AdaptiveReach, parse_radius, scan_ranges
from ggslam.localization.scan_look_up import ScanLookUp
from ggslam.localization.scan_maps import scan_places
from ggslam.localization.scan_tracker import ScanTracker, ScanTrackerSettings
from ggslam.localization.scans import ScanSequence, scan_files
from ggslam.localization.surface import NORMAL, SCAN_TARGET, FullSurface, PartialSurface, packed_normals
from ggslam.localization.visits import FrameSights, record_visit
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import rotation_about
from ggslam.sequences import open_sequence
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import store_cloud
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.json_files import json_ready
from ggslam.system.process_memory import peak_memory_mb
from ggslam.tracking.settings import TargetSettings, TrackerSettings

OUTDOORS = SubmapSettings(axes="xy", voxel=0.0, cache_megabytes=100)


RIGHT = 0.2
"""Metres from the truth within which a scan is at its place."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    cases = parser.add_subparsers(dest="case", required=True)
    world = cases.add_parser("world", help="a generated world: FOLDER/map.grid, FOLDER/scans, FOLDER/trajectory.txt")
    world.add_argument("folder", type=Path)
    world.add_argument("--size", type=float, default=100.0)
    world.add_argument("--spacing", type=float, default=0.1, help="of the map's points")
    world.add_argument("--scans", type=int, default=150)
    world.add_argument("--seed", type=int, default=0)
    world.add_argument("--kind", choices=("rooms", "halls", "equal"), default="rooms", help="see tests/worlds/special")
    world.add_argument("--changed", type=float, default=0.0, help="share of things moved between map and scans")
    world.add_argument("--stretch", type=float, default=1.0, help="of the map along x and y, as where odometry drifted")
    world.add_argument("--every", type=int, default=1, help="of the walk's poses, 12 cm apart, one in so many is used")
    room = cases.add_parser("room", help="the first frames of a recording with their true poses: FOLDER/map.grid")
    room.add_argument("folder", type=Path)
    room.add_argument("--recording", type=Path, required=True)
    room.add_argument("--stop", type=int, default=150)
    room.add_argument("--scale", type=float, default=0.5)
    locate = cases.add_parser("locate")
    locate.add_argument("store", type=Path)
    locate.add_argument("sequence", type=Path)
    locate.add_argument("--full", action="store_true")
    locate.add_argument("--tree", action="store_true", help="the reference of scripts/benchmarks/kdtree_gicp.py")
    locate.add_argument("--voxel", type=float, default=0.15)
    locate.add_argument("--radius", type=parse_radius, default=10.0)
    locate.add_argument("--first", type=int, default=0)
    locate.add_argument("--stop", type=int)
    locate.add_argument("--scale", type=float, default=0.5)
    starts = cases.add_parser("starts", help="scans one by one, each from starts that are off")
    starts.add_argument("store", type=Path)
    starts.add_argument("sequence", type=Path)
    starts.add_argument("--full", action="store_true")
    starts.add_argument("--radius", type=parse_radius, default=10.0)
    starts.add_argument("--off", type=float, nargs=2, default=(2.0, 10.0), help="metres and degrees")
    starts.add_argument("--count", type=int, default=10, help="of scans")
    near = cases.add_parser("near", help="scans without a start pose, looked up near a position")
    near.add_argument("store", type=Path)
    near.add_argument("sequence", type=Path)
    near.add_argument("--sigma", type=float, help="of the position, metres; default: none is given")
    near.add_argument("--off", type=float, default=0.0, help="metres that it is wrong along x")
    near.add_argument("--range", type=float, default=6.0, help="of the scanner, metres")
    near.add_argument("--count", type=int, default=6, help="of scans")
    a = parser.parse_args()
    began = time.perf_counter()
    if a.case == "world":
        found = make_world(a.folder, a.kind, a.size, a.spacing, a.scans, a.seed, a.changed, a.every, a.stretch)
    elif a.case == "room":
        found = make_room(a.folder, a.recording, a.stop, a.scale)
    elif a.case == "starts":
        found = started(a.store, a.sequence, a.full, a.radius, a.off[0], a.off[1], a.count)
    elif a.case == "near":
        found = looked_up(a.store, a.sequence, a.sigma, a.off, a.range, a.count)
    else:
        found = located(a.store, a.sequence, a.full, a.tree, a.voxel, a.radius, a.first, a.stop, a.scale)
    print(json.dumps(json_ready({**found, "seconds": time.perf_counter() - began, "peak_mb": peak_memory_mb()})))


def make_world(
    folder: Path, kind: str, size: float, spacing: float, scans: int, seed: int, share: float, every: int,
    stretch: float,
) -> dict[str, Any]:  # fmt: skip
    """Writes the map of a generated world, and scans along a walk in it with the true poses in the map, with a share of
    its things moved since."""
    from worlds.cloud import cloud_tiles
    from worlds.plan import make_world as planned
    from worlds.scanner import Scanner
    from worlds.special import changed, equal_rooms, hall_world
    from worlds.walk import SPEED, walk

    from ggslam.formats.trajectory import write_tum

    shutil.rmtree(folder, ignore_errors=True)
    (folder / "scans").mkdir(parents=True)
    world = {"rooms": planned, "halls": hall_world, "equal": equal_rooms}[kind](size, seed)
    poses = walk(world, scans * every * SPEED / 10 + 1, seed)[: scans * every : every]
    today = changed(world, share, seed) if share else world
    for number, T in enumerate(poses):
        np.save(folder / "scans" / f"{number:06d}.npy", Scanner().scan(today, T, number).points)
    wide = np.array([stretch, stretch, 1.0])
    poses[:, :3, 3] *= wide
    write_tum(folder / "trajectory.txt", np.arange(len(poses)) / 10, poses)
    tiles = [
        ((points * wide).astype(np.float32), packed_normals(normals)) for points, normals in cloud_tiles(world, spacing)
    ]
    points, normals = (np.concatenate(arrays) for arrays in zip(*tiles, strict=True))
    tiles.clear()
    with GridStore.create(folder / "map.grid", OUTDOORS) as store:
        cells = len(store_cloud(store, points, {NORMAL: normals}))
    return {"points": len(points), "cells": cells}


def make_room(folder: Path, recording: Path, stop: int, scale: float) -> dict[str, Any]:
    """Records frames with the recording's own poses."""
    shutil.rmtree(folder, ignore_errors=True)
    frames = open_sequence(recording, stop=stop, scale=scale)
    assert frames.ground_truth is not None
    # Every place within a cell counts as near its centre: a hand-held camera does not pass by the centres.
    with GridStore.create(folder / "map.grid", replace(INDOORS, spacing=1.0, radius=0.9)) as store:
        sights = FrameSights(frames.camera, NativeContext())
        cells = record_visit(store, frames.stream(masks=False), frames.ground_truth, sights, "map")
        points = sum(store.cell(key).parts["points.pcd"].count for key in store.cells())
    return {"points": points, "cells": len(cells)}


def located(
    path: Path, sequence: Path, full: bool, tree: bool, voxel: float, radius: float | Literal["auto"], first: int,
    stop: int | None, scale: float,
) -> dict[str, Any]:  # fmt: skip
    """Locates a recording from its first given pose; times by frame."""
    before = peak_memory_mb()
    context = NativeContext()
    with GridStore.open(path) as store:
        target = replace(SCAN_TARGET if scan_files(sequence) else TargetSettings(), voxel=voxel)
        submaps = store.settings if radius == AUTO else replace(store.settings, partial_radius=radius)
        surface: Any
        if tree:
            surface = TreeSurface(store, submaps, full)
        else:
            surface = FullSurface(store, target, context) if full else PartialSurface(store, target, context, submaps)
        if scan_files(sequence):
            scans = ScanSequence(sequence, first, stop)
            truth, times = scans.ground_truth, scans.timestamps
            assert truth is not None
            tracker: Any = TreeTracker(truth[0]) if tree else ScanTracker(ScanTrackerSettings(), context, truth[0])
            reach = AdaptiveReach(surface, scan_ranges) if radius == AUTO else None
            by_scan = Localizer(surface, tracker, truth[0], reach)
            results, processor = timed(by_scan, [scan.points for scan in scans.stream()])
        else:
            frames = open_sequence(sequence, start=first, stop=stop, scale=scale)
            truth, times = frames.ground_truth, frames.timestamps
            assert truth is not None
            by_frame = Localizer(surface, FrameTracker(frames.camera, TrackerSettings(), context, truth[0]), truth[0])
            results, processor = timed(by_frame, frames.stream(prefetch=0, masks=False))
        surface.close()
    summary = LocalizationReport(str(path), str(sequence), full, times, results, truth).summary()
    return {
        **summary, "before_mb": before, "map_ms": [1e3 * r.map_seconds for r in results],
        "align_ms": [1e3 * r.align_seconds for r in results], "processor_ms": processor,
    }  # fmt: skip


def started(
    path: Path, sequence: Path, full: bool, radius: float | Literal["auto"], off: float, turn: float, count: int
) -> dict[str, Any]:
    """Locates scans one by one, each from four starts `off` metres and `turn` degrees from the truth: how many were
    right (within `RIGHT`), elsewhere without a word, elsewhere but told to be doubtful, and lost."""
    context, outcomes, errors = NativeContext(), Counter[str](), []
    scans = ScanSequence(sequence)
    truth = scans.ground_truth
    assert truth is not None
    with GridStore.open(path) as store:
        submaps = store.settings if radius == AUTO else replace(store.settings, partial_radius=radius)
        whole = FullSurface(store, SCAN_TARGET, context)
        surface = whole if full else PartialSurface(store, SCAN_TARGET, context, submaps)
        for number in np.linspace(0, len(scans) - 1, count).round().astype(int).tolist():
            for side in range(4):
                start = truth[number].copy()
                start[:2, 3] += off * np.array([np.cos(side * np.pi / 2 + 0.5), np.sin(side * np.pi / 2 + 0.5)])
                start[:3, :3] = rotation_about(np.array([0.0, 0, 1]), turn * (-1) ** side) @ start[:3, :3]
                tracker = ScanTracker(ScanTrackerSettings(), context, start)
                reach = AdaptiveReach(surface, scan_ranges) if radius == AUTO and not full else None
                found = Localizer(surface, tracker, start, reach).locate(scans.scan(number).points)
                away = float(np.linalg.norm(found.T_world_sensor[:3, 3] - truth[number][:3, 3]))
                outcomes[_outcome(found, away)] += 1
                errors += [away] if found.status.is_located and away < RIGHT else []
        surface.close()
    rmse = float(np.sqrt(np.mean(np.square(errors)))) if errors else None
    return {"outcomes": dict(outcomes), "starts": 4 * count, "rmse_m": rmse}


def looked_up(
    path: Path, sequence: Path, sigma: float | None, off: float, farthest: float, count: int
) -> dict[str, Any]:
    """Looks scans up one by one, near a position that is `off` metres wrong: how many were right, elsewhere and lost,
    and RMSE of the right ones."""
    context, outcomes, errors = NativeContext(), Counter[str](), []
    scans = ScanSequence(sequence)
    truth = scans.ground_truth
    assert truth is not None
    with GridStore.open(path) as store, PartialSurface(store, SCAN_TARGET, context) as surface:
        for number in np.linspace(0, len(scans) - 1, count).round().astype(int).tolist():
            x, y = truth[number][:2, 3].tolist()
            near = None if sigma is None else Near((x + off, y), sigma)
            look_up = ScanLookUp(partial(scan_places, store, near), store.settings.axes, near=near)
            points = scans.scan(number).points
            points = points[np.linalg.norm(points, axis=1) < farthest]
            tracker = ScanTracker(ScanTrackerSettings(), context, None, look_up)
            found = Localizer(surface, tracker, None).locate(points)
            away = float(np.linalg.norm(found.T_world_sensor[:3, 3] - truth[number][:3, 3]))
            outcomes[_outcome(found, away)] += 1
            errors += [away] if found.status.is_located and away < RIGHT else []
    rmse = float(np.sqrt(np.mean(np.square(errors)))) if errors else None
    return {"outcomes": dict(outcomes), "rmse_m": rmse}


def _outcome(found: Localization, away: float) -> str:
    if not found.status.is_located:
        return "lost"
    if away < RIGHT:
        return "right"
    return "doubtful" if found.status is LocalizationStatus.DEGENERATE else "wrong"


def timed(localizer: Localizer[Any], items: Iterable[Any]) -> tuple[list[Localization], list[float]]:
    """Locates all, and the milliseconds that all threads together worked on each, those that load ahead included."""
    results, processor = [], []
    for item in items:
        before = time.process_time()
        results.append(localizer.locate(item))
        processor.append(1e3 * (time.process_time() - before))
    return results, processor


if __name__ == "__main__":
    main()
