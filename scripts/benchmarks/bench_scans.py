#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Laser scans of a real ride located in maps of R' 10 m, 30 m and all of it, and from starts that are off.

    python scripts/benchmarks/bench_scans.py rides/kitti --columns 4
    python scripts/benchmarks/bench_scans.py rides/kitti --columns 4 --peer-python peers/bin/python

The folder has scans and trajectory.txt (see ggslam/localization/scans.py). No scan is located in a map that it is part
of, which would flatter the result: of up to --alone scans each is located in a map of all others, of more every second
one makes the map. The given poses are the truth: the table cannot be better than they are.

    radius    points, time a scan and RMSE by R'; each scan from its given pose
    starts    found of --repeat starts, moved by 0 to 3 m in random directions and turned by 0 to 15 degrees; a pose is
              found within 5 cm and 0.5 degrees; "false" are poses elsewhere that were not said to be lost

With --peer-python the starts are also aligned by small_gicp (GICP, that interpreter's package), in turns with ours, in
the same map, thinned to 0.25 m as its examples do, correspondences up to 2 m. It has no word for "lost".
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np

from ggslam.jobs.submaps.sensor_settings import settings_of_scans
from ggslam.localization.localizer import Localizer
from ggslam.localization.scan_tracker import ScanTracker, ScanTrackerSettings
from ggslam.localization.scans import ScanSequence
from ggslam.localization.surface import SCAN_TARGET, FullSurface, PartialSurface, Surface, point_spacing
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import se3_exp, separation, transform_points
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import store_cloud

OFFSETS, TURNS = (0.0, 0.5, 1.0, 2.0, 3.0), (0.0, 5.0, 10.0, 15.0)
_FOUND_M, _FOUND_DEG = 0.05, 0.5
_PEER = """
import sys, time, json, numpy as np, small_gicp
d = np.load(sys.argv[1]); out = []
began = time.perf_counter()
target, tree = small_gicp.preprocess_points(d["target"], 0.25, num_threads=2)
made = time.perf_counter() - began
for guess in d["guesses"]:
    began = time.perf_counter()
    source, _ = small_gicp.preprocess_points(d["source"], 0.25, num_threads=2)
    r = small_gicp.align(target, source, tree, guess, registration_type="GICP", max_correspondence_distance=2.0,
                         num_threads=2, max_iterations=60)
    out.append([r.T_target_source.tolist(), time.perf_counter() - began])
print(json.dumps({"made": made, "poses": out}))
"""
Found = tuple[np.ndarray, bool, float]
"""Pose, whether it is said to be located, seconds."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--columns", type=int)
    parser.add_argument("--parts", nargs="+", choices=("radius", "starts"), default=["radius", "starts"])
    parser.add_argument("--alone", type=int, default=10)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--voxel", type=float, default=0.05, help="of the map, metres")
    parser.add_argument("--scan", type=int, help="that the starts are of; default: the middle one")
    parser.add_argument("--peer-python", type=Path)
    a = parser.parse_args()
    scans = ScanSequence(a.folder, columns=a.columns)
    assert scans.ground_truth is not None, "no poses"
    points = [scan.points for scan in scans.stream()]
    settings = replace(settings_of_scans(scans, cut=True), voxel=a.voxel, lookahead=0.0)
    mean = np.mean([len(p) for p in points])
    print(f"{a.folder}: {len(points)} scans of {mean:.0f} points, R' {settings.partial_radius:g} m suits the scanner")
    with tempfile.TemporaryDirectory() as work:
        bench = Bench(points, scans.ground_truth, settings, Path(work), a)
        if "radius" in a.parts:
            bench.radius()
        if "starts" in a.parts:
            bench.starts()


class Bench:
    """The parts, on one recording."""

    def __init__(
        self, scans: list[np.ndarray], poses: np.ndarray, settings: Any, work: Path, arguments: argparse.Namespace
    ) -> None:
        self.scans, self.poses, self.settings, self.work, self.a = scans, poses, settings, work, arguments
        self.context = NativeContext()
        self._stores: dict[int, GridStore] = {}

    def map_of(self, scan: int) -> tuple[GridStore, np.ndarray]:
        """The store that a scan is located in, and the points it was made of."""
        alone = len(self.scans) <= self.a.alone
        rest = [n for n in range(len(self.scans)) if (n != scan if alone else n % 2 == 0)]
        points = np.concatenate([transform_points(self.scans[n].astype(float), self.poses[n]) for n in rest])
        key = scan if alone else 0
        if key not in self._stores:
            store = GridStore.create(self.work / f"{key}.grid", self.settings)
            store_cloud(store, points)
            self._stores[key] = store
        return self._stores[key], points

    def located(self) -> list[int]:
        """Numbers of the scans that are located."""
        return [n for n in range(len(self.scans)) if len(self.scans) <= self.a.alone or n % 2]

    def surface(self, store: GridStore, radius: float | None) -> Surface:
        """The map within `radius` metres, or all of it."""
        voxel = max(SCAN_TARGET.voxel, 1.5 * store.settings.voxel, 1.5 * point_spacing(store))
        target = replace(SCAN_TARGET, voxel=voxel)
        if radius is None:
            return FullSurface(store, target, self.context)
        return PartialSurface(store, target, self.context, replace(store.settings, partial_radius=radius))

    def radius(self) -> None:
        """Prints what R' costs."""
        print("\n   R' m    points  map ms  align ms   RMSE mm   of full  turn deg  located  beyond")
        rows = {radius: self._radius(radius) for radius in (10.0, 30.0, None)}
        full = rows[None][3]
        for radius, (points, made, align, rmse, turn, share, beyond) in rows.items():
            name = "full" if radius is None else f"{radius:g}"
            print(f"{name:>7} {points:9.0f} {made:7.0f} {align:9.1f} {rmse:9.2f} {rmse / full:8.2f}x {turn:9.3f} "
                  f"{100 * share:6.0f} % {100 * beyond:5.0f} %", flush=True)  # fmt: skip

    def _radius(self, radius: float | None) -> tuple[float, ...]:
        errors, turns, points, made, align, located, beyond = [], [], [], [], [], [], []
        for number in self.located():
            store, _ = self.map_of(number)
            runs = []
            for _ in range(self.a.repeat):
                surface, T = self.surface(store, radius), self.poses[number]
                tracker = ScanTracker(ScanTrackerSettings(), self.context, T)
                runs.append(Localizer(surface, tracker, T).locate(self.scans[number]))
                surface.close()
            found = runs[0]
            located.append(found.status.is_located)
            moved, turned = separation(found.T_world_sensor, T)
            for values, value in ((errors, moved), (turns, turned), (points, found.map_points), (beyond, found.beyond)):
                values.append(value)
            made.append(min(r.map_seconds for r in runs))
            align.append(min(r.align_seconds for r in runs))
        rmse, turn = (float(np.sqrt(np.mean(np.square(values)))) for values in (errors, turns))
        return (float(np.mean(points)), 1e3 * float(np.mean(made)), 1e3 * float(np.mean(align)), 1e3 * rmse, turn,
                float(np.mean(located)), float(np.mean(beyond)))  # fmt: skip

    def starts(self) -> None:
        """Prints what comes of starts that are off, ours and the peer's by turns."""
        numbers = self.located()
        scan = numbers[len(numbers) // 2] if self.a.scan is None else self.a.scan
        store, cloud = self.map_of(scan)
        results: dict[str, dict[tuple[float, float], list[Found]]] = {}
        for repeat in range(self.a.repeat):
            guesses = {(o, t): moved_pose(self.poses[scan], o, t, repeat) for o in OFFSETS for t in TURNS}
            for radius in (10.0, 30.0, None):
                ours = results.setdefault("full map" if radius is None else f"R' {radius:g} m", {})
                for key, found in zip(guesses, self._ours(scan, store, radius, list(guesses.values())), strict=True):
                    ours.setdefault(key, []).append(found)
            if self.a.peer_python is not None:
                peer = results.setdefault("small_gicp", {})
                for key, found in zip(guesses, self._peer(scan, cloud, list(guesses.values())), strict=True):
                    peer.setdefault(key, []).append(found)
        for name, cells in results.items():
            self._print_starts(name, cells, self.poses[scan])

    def _ours(self, scan: int, store: GridStore, radius: float | None, guesses: list[np.ndarray]) -> Iterator[Found]:
        full = self.surface(store, None) if radius is None else None
        for guess in guesses:
            surface = self.surface(store, radius) if full is None else full
            tracker = ScanTracker(ScanTrackerSettings(), self.context, guess)
            found = Localizer(surface, tracker, guess).locate(self.scans[scan])
            yield found.T_world_sensor, found.status.is_located, found.align_seconds

    def _peer(self, scan: int, cloud: np.ndarray, guesses: list[np.ndarray]) -> Iterator[Found]:
        path = self.work / "peer.npz"
        np.savez(path, target=cloud, source=self.scans[scan].astype(float), guesses=np.array(guesses))
        words = [self.a.peer_python, "-c", _PEER, path]
        output = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True, env={}).stdout
        for pose, seconds in json.loads(output)["poses"]:
            yield np.array(pose), True, seconds

    def _print_starts(self, name: str, cells: dict[tuple[float, float], list[Found]], truth: np.ndarray) -> None:
        every = [found for several in cells.values() for found in several]
        right = [is_found(T, truth) and located for T, located, _ in every]
        false = sum(located and not is_found(T, truth) for T, located, _ in every)
        errors = [1e3 * separation(T, truth)[0] for (T, _, _), ok in zip(every, right, strict=True) if ok]
        ms = 1e3 * np.array([seconds for _, _, seconds in every])
        low, middle, high = np.percentile(ms, [10, 50, 90]).tolist()
        print(
            f"\n{name}: {sum(right)} of {len(every)} found, {false} false; of those found median "
            f"{np.median(errors):.1f} mm, worst {max(errors):.1f} mm; {middle:.0f} ms a start (10 to 90 %: "
            f"{low:.0f} to {high:.0f})"
        )
        print("   off m " + "".join(f"{turn:7g} deg" for turn in TURNS))
        for off in OFFSETS:
            counts = [sum(is_found(T, truth) and ok for T, ok, _ in cells[off, turn]) for turn in TURNS]
            print(f"{off:8g} " + "".join(f"{f'{count} / {self.a.repeat}':>11}" for count in counts), flush=True)


def moved_pose(T: np.ndarray, off: float, degrees: float, seed: int) -> np.ndarray:
    """A pose moved over the ground in a random direction and turned about z, either way."""
    rng = np.random.default_rng([seed, round(100 * off), round(degrees)])
    direction, sign = rng.uniform(0, 2 * np.pi), rng.choice([-1, 1])
    moved = T.copy()
    moved[:3, :3] = se3_exp(np.array([0, 0, 0, 0, 0, sign * np.radians(degrees)]))[:3, :3] @ T[:3, :3]
    moved[:2, 3] += off * np.array([np.cos(direction), np.sin(direction)])
    return moved


def is_found(T: np.ndarray, truth: np.ndarray) -> bool:
    """Whether a pose is the true one."""
    moved, turned = separation(T, truth)
    return moved < _FOUND_M and turned < _FOUND_DEG


if __name__ == "__main__":
    began = time.perf_counter()
    main()
    print(f"\n{time.perf_counter() - began:.0f} s in all")
