#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Looking scans up that nothing is known of: how many are found, and how many where they are not.

    python scripts/benchmarks/bench_lookup.py --folder /tmp/lookup
    python scripts/benchmarks/bench_lookup.py --folder /tmp/lookup --submaps data/submaps --strangers data/other

Parts:
    world     a generated world of SIZE x SIZE metres, once as a store that scans along a walk were recorded in and once
              as a cloud; scans 0 to 3 m away from the walk at any azimuth, and scans of another world
    index     time to look one view up among 1000, 10,000, 100,000 places, without verifying what is found
    submaps   clouds with poses (folders with points.bin, graph.txt): each is looked up in a map of the others, turned
              at random; --strangers, a folder of scans of another place (.bin), must not be found

found: within 10 cm and 1 degree; false: found, but elsewhere. Times are of the whole look-up: candidates, alignment,
judgement.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
from worlds.cloud import cloud_tiles
from worlds.plan import make_world
from worlds.pose_graph import read_pose_graph
from worlds.scanner import Scanner
from worlds.walk import walk
from worlds.world import World, cast_rays

from ggslam.formats.cloud_files import read_cloud_file
from ggslam.localization.level import about_z
from ggslam.localization.localizer import Localization, Localizer
from ggslam.localization.map_picture import picture_of_store
from ggslam.localization.scan_look_up import Guesser, ScanLookUp
from ggslam.localization.scan_places import ScanPlaces, place_of, recorded_places
from ggslam.localization.scan_tracker import ScanTracker, ScanTrackerSettings
from ggslam.localization.scan_views import CODE_BYTES, ViewIndex
from ggslam.localization.scans import LaserScan, ScanSequence, scan_files
from ggslam.localization.surface import NORMAL, SCAN_TARGET, PartialSurface, packed_normals
from ggslam.localization.visits import ScanSights, record_visit
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import separation, transform_points
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import store_cloud
from ggslam.submaps.settings import SubmapSettings
from ggslam.tracking.scan_points import ScanSettings

INDOORS = SubmapSettings(axes="xy", voxel=0.05, radius=1.5, refresh=0.0)
OUTDOORS = SubmapSettings(spacing=10.0, radius=8.0, axes="xy", voxel=0.0, partial_radius=60.0, sensor_range=80.0)
OUTDOOR_VOXEL, OUTDOOR_SCANS = 0.4, ScanTrackerSettings(scan=ScanSettings(voxel=0.5, nearest=2.5), sigma=0.05)

Query = tuple[np.ndarray, np.ndarray | None]
"""A scan and its pose T_world_sensor; None: it is of another place."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="for stores, which are made anew")
    parts = ("world", "index", "submaps")
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    parser.add_argument("--size", type=float, default=100.0, help="metres")
    parser.add_argument("--walk", type=float, default=300.0, help="metres of the walk that is recorded")
    parser.add_argument("--queries", type=int, default=20, help="scans of each distance from the walk")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--submaps", type=Path)
    parser.add_argument("--strangers", type=Path, nargs="*", default=[])
    a = parser.parse_args()
    a.folder.mkdir(parents=True, exist_ok=True)
    print(f"{'':34} scans found false    error mm      seconds a scan")
    if "world" in a.parts:
        world(a)
    if "submaps" in a.parts and a.submaps is not None:
        submaps(a)
    if "index" in a.parts:
        index()


def world(a: argparse.Namespace) -> None:
    """Prints what is found in a generated world."""
    made, scanner = make_world(a.size, a.seed), Scanner()
    poses = walk(made, a.walk, a.seed)[::3]
    queries = {
        f"{away:g} m away": [query(made, scanner, poses, away, 1000 * a.seed + n) for n in range(a.queries)]
        for away in (0.0, 0.5, 1.0, 2.0, 3.0)
    }
    other = make_world(a.size, a.seed + 7)
    strange = walk(other, a.walk, a.seed)[:: max(1, int(a.walk * 10 / 1.2 / (2 * a.queries)))]
    queries["another world"] = [(scanner.scan(other, T, n).points, None) for n, T in enumerate(strange)]
    with fresh(a.folder / "recorded.grid", INDOORS) as store:
        items = (LaserScan(n, n * 0.3, scanner.scan(made, T, n).points) for n, T in enumerate(poses))
        record_visit(store, items, poses, ScanSights("xy"), "walk")
        places = recorded_places(store)
        print(f"{len(places)} places recorded along {a.walk:g} m of a world of {a.size:g} m")
        for name, wanted in queries.items():
            show(f"recorded, {name}", store, places, wanted)
    with fresh(a.folder / "cloud.grid", replace(INDOORS, voxel=0.0)) as store:
        tiles = list(cloud_tiles(made, 0.12))
        points, normals = (np.concatenate(arrays) for arrays in zip(*tiles, strict=True))
        store_cloud(store, points, {NORMAL: packed_normals(normals)})
        picture = picture_of_store(store)
        for name, wanted in queries.items():
            show(f"cloud, {name}", store, picture, wanted)


def query(made: World, scanner: Scanner, poses: np.ndarray, away: float, seed: int) -> Query:
    """A scan so far from the walk, in view of it, at any azimuth."""
    rng = np.random.default_rng([seed, int(10 * away)])
    while True:
        T, angle = np.eye(4), rng.uniform(-np.pi, np.pi)
        step = np.array([np.cos(angle), np.sin(angle), 0.0])
        start = poses[rng.integers(len(poses)), :3, 3]
        if away and cast_rays(made, start[None], step[None], 30.0).distance[0] < away + 0.3:
            continue
        T[:3, :3], T[:3, 3] = about_z(rng.uniform(-np.pi, np.pi)), start + away * step
        return scanner.scan(made, T, seed).points, T


def submaps(a: argparse.Namespace) -> None:
    """Prints what is found of clouds in a map of the others."""
    poses = read_pose_graph(a.submaps / "graph.txt")
    folders = sorted(path for path in a.submaps.iterdir() if (path / "points.bin").is_file())
    clouds = [read_cloud_file(path / "points.bin").points for path in folders]
    truth = [T for _, T in zip(folders, poses.values(), strict=True)]
    strangers = [scan.points for path in a.strangers if scan_files(path) for scan in ScanSequence(path).stream()]
    rng = np.random.default_rng(a.seed)
    for left_out, folder in enumerate(folders):
        others = [n for n in range(len(folders)) if n != left_out]
        nearest = min(np.linalg.norm(truth[n][:3, 3] - truth[left_out][:3, 3]) for n in others)
        turn = np.eye(4)
        turn[:3, :3] = about_z(rng.uniform(-np.pi, np.pi))
        own = (transform_points(clouds[left_out], np.linalg.inv(turn)), truth[left_out] @ turn)
        with fresh(a.folder / "submaps.grid", OUTDOORS) as store:
            store_cloud(store, np.concatenate([transform_points(clouds[n], truth[n]) for n in others]))
            seen = [place for n in others if (place := place_of(clouds[n], truth[n], "xy")) is not None]
            positions, floors = np.array([place.position for place in seen]), np.array([place.floor for place in seen])
            places = ScanPlaces(positions, floors, np.array([place.code for place in seen]), "xy")
            for kind, guesser in (("recorded", places), ("cloud", picture_of_store(store))):
                show(f"{kind}, {folder.name}, {nearest:.1f} m away", store, guesser, [own])
                if strangers:
                    show(f"{kind}, strangers", store, guesser, [(scan, None) for scan in strangers])


def fresh(path: Path, settings: SubmapSettings) -> GridStore:
    """An empty store."""
    shutil.rmtree(path, ignore_errors=True)
    return GridStore.create(path, settings)


def show(name: str, store: GridStore, places: Guesser, queries: Sequence[Query]) -> None:
    """Prints what came of looking scans up."""
    errors, false, seconds = [], 0, []
    for scan, T in queries:
        result, spent = locate(store, places, scan)
        seconds.append(spent)
        if not result.status.is_located:
            continue
        moved, turned = (np.inf, np.inf) if T is None else separation(result.T_world_sensor, T)
        if moved < 0.1 and turned < 1:
            errors.append(1e3 * moved)
        else:
            false += 1
    told = f"{np.median(errors):5.1f} at most {max(errors):5.1f}" if errors else f"{'-':>5}{'':14}"
    print(
        f"{name:34} {len(queries):5} {len(errors):5} {false:5} {told} {np.median(seconds):8.2f} at most "
        f"{max(seconds):.2f}", flush=True,
    )  # fmt: skip


def locate(store: GridStore, places: Guesser, scan: np.ndarray) -> tuple[Localization, float]:
    """Looks a scan up, and the seconds it took."""
    context, outdoors = NativeContext(), store.settings.sensor_range > 30
    target = replace(SCAN_TARGET, voxel=OUTDOOR_VOXEL) if outdoors else SCAN_TARGET
    settings = OUTDOOR_SCANS if outdoors else ScanTrackerSettings()
    with PartialSurface(store, target, context) as surface:
        look_up = ScanLookUp(lambda: places, store.settings.axes)
        localizer = Localizer(surface, ScanTracker(settings, context, None, look_up), None)
        began = time.perf_counter()
        return localizer.locate(scan.astype(np.float32)), time.perf_counter() - began


def index() -> None:
    """Prints what a query takes, of places whose views are random in the way that real ones are sparse."""
    rng = np.random.default_rng(0)
    print("\nplaces      MB   query of 19 views, ms")
    for count in (1000, 10_000, 100_000):
        codes = np.packbits(rng.random((count, CODE_BYTES * 8)) < 0.08, axis=1)
        held = ViewIndex(codes)
        held.query(codes[:19])
        times = []
        for number in range(5):
            began = time.perf_counter()
            held.query(codes[number : number + 19])
            times.append(1e3 * (time.perf_counter() - began))
        print(f"{count:6} {held.nbytes / 1e6:7.1f} {min(times):9.1f}")


if __name__ == "__main__":
    main()
