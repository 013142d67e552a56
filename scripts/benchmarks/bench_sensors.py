#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Volumes of other sensors than one small camera: points a second, and how far surfaces are from the truth.

    python scripts/benchmarks/bench_sensors.py
    python scripts/benchmarks/bench_sensors.py --parts scans --submaps data/clouds/kitti_07_submaps
    python scripts/benchmarks/bench_sensors.py --parts ranges

Parts:
    scans     laser scanners of 16, 64 and 128 rings walk through a generated world; with --submaps also clouds with
              poses (folders with points.bin, graph.txt), each as a scan from its pose
    cameras   rigs of one to four cameras of 640x480, and one of 1280x720, in a room with a ball
    ranges    the scanner of 64 rings in a world four times as large, seen up to 40 m: by the range of what is seen, how
              far surfaces are from the truth, and how much of what was measured has none

Times are CPU time, that of all threads added up. off: distance of the mesh's vertices from the true surface.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "volumes"))

import numpy as np
from analytic_scenes import Box, Sphere, Union, looking_at, render_depth, small_camera
from scipy.spatial import cKDTree
from worlds.distance import world_distance
from worlds.plan import make_world
from worlds.pose_graph import read_pose_graph
from worlds.scanner import Scanner
from worlds.walk import walk

from ggslam.formats.cloud_files import read_cloud_file
from ggslam.scene.poses import transform_points
from ggslam.volumes.maps import VolumeMaps
from ggslam.volumes.posed_view import PosedScan, PosedView
from ggslam.volumes.scan_faces import ScanFaces
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.volume_settings import VolumeSettings

SCANNERS = {
    "16 rings, 900": Scanner(rings=16, columns=900, lowest_deg=-15, highest_deg=15, noise=0.0),
    "64 rings, 1024": Scanner(rings=64, columns=1024, lowest_deg=-24, highest_deg=4, noise=0.0),
    "64 rings, 2 cm": Scanner(rings=64, columns=1024, lowest_deg=-24, highest_deg=4, noise=0.02),
    "128 rings, 2048": Scanner(rings=128, columns=2048, noise=0.0),
}
ROOM = Union((Box((-2.0, -1.3, -2.2), (2.3, 1.4, 1.9), inside_out=True), Sphere((0.9, 0.4, 0.8), 0.4)))
LARGE = 4.0
"""How many times as large the world of `ranges` is: halls of up to 40 m."""
RANGES = (0, 5, 10, 15, 20, 30, 40)
"""Metres from the nearest scanner."""
SIDES = np.array([(0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0)], float)


def fuse(instants: Sequence[list[PosedView] | list[PosedScan]], voxel: float, max_depth: float, occupancy: float
         ) -> tuple[VolumeMaps, dict[str, float]]:  # fmt: skip
    """The maps, and million points a second of the TSDF, the occupancy map and both."""
    settings = VolumeSettings(tsdf=TsdfSettings(voxel=voxel, max_depth=max_depth))
    tsdf, both = VolumeMaps(settings), VolumeMaps(settings, occupancy=occupancy)
    spent = [_spent(partial(_add_all, maps, instants)) for maps in (tsdf, both)]
    points = tsdf.points / 1e6
    occupied = points / max(1e-9, spent[1] - spent[0])
    return both, {"tsdf": points / spent[0], "occupancy": occupied, "all": points / spent[1]}


def _add_all(maps: VolumeMaps, instants: Sequence[list[PosedView] | list[PosedScan]]) -> None:
    for views in instants:
        maps.add_together(views)


def _spent(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def line(name: str, maps: VolumeMaps, rates: dict[str, float], off: np.ndarray | None) -> None:
    """Prints a row."""
    words = ""
    if off is not None:
        off = 1e3 * off
        words = f"   off {np.median(off):.2f} mm (median), {off.mean():.1f} (mean), {np.percentile(off, 95):.1f} (95 %)"
    print(
        f"{name:30} {maps.points / len(maps.times.rows):9.0f} points an instant, {rates['all']:5.1f} million/s "
        f"(TSDF {rates['tsdf']:.1f}, occupancy {rates['occupancy']:.1f}){words}", flush=True,
    )  # fmt: skip


def scans(submaps: Path | None) -> None:
    """Laser scanners."""
    world = make_world(30.0, 3)
    poses = walk(world, 8.0, 1)[::4]
    for voxel in (0.05, 0.1):
        for name, scanner in SCANNERS.items():
            found = [scanner.scan(world, T, k).points for k, T in enumerate(poses)]
            faces = ScanFaces.of(found[0])
            seen = [[PosedScan(points, T, faces)] for points, T in zip(found, poses, strict=True)]
            maps, rates = fuse(seen, voxel, 10.0, 2 * voxel)
            line(f"{name}, {100 * voxel:g} cm", maps, rates, np.abs(world_distance(world, maps.mesh(50).vertices)))
    if submaps is not None:
        folders = sorted(path for path in submaps.iterdir() if (path / "points.bin").is_file())
        graph = read_pose_graph(submaps / "graph.txt").values()
        clouds = [(read_cloud_file(path / "points.bin").points, T) for path, T in zip(folders, graph, strict=True)]
        seen = [[PosedScan(p.astype(np.float32), T, ScanFaces.of(p))] for p, T in clouds]
        maps, rates = fuse(seen, 0.2, 40.0, 0.4)
        line(f"{submaps.name}, 20 cm", maps, rates, None)


def cameras() -> None:
    """Rigs, and a large image."""
    for count, width, height in ((1, 640, 480), (2, 640, 480), (3, 640, 480), (4, 640, 480), (1, 1280, 720)):
        camera, seen = small_camera(width, height), []
        for x in np.linspace(-0.5, 0.4, 6):
            at = np.array([x, 0.05, -0.2])
            poses = [looking_at(at + 0.06 * side, at + side) for side in SIDES[:count]]
            seen.append([PosedView(render_depth(ROOM, camera, T), camera, T) for T in poses])
        maps, rates = fuse(seen, 0.02, 7.0, 0.05)
        off = np.abs(ROOM.distance(maps.mesh(50).vertices.astype(float)))
        line(f"{count} x {width}x{height}, 2 cm", maps, rates, off)


def ranges() -> None:
    """A scanner of 64 rings in a world four times as large: errors by the distance from the nearest place of a scan."""
    world, scanner = make_world(30.0, 3), SCANNERS["64 rings, 2 cm"]
    small = replace(scanner, farthest=80 / LARGE, noise=scanner.noise / LARGE)
    poses = walk(world, 8.0, 1)[::4]
    placed = [_scaled(T) for T in poses]
    found = [(LARGE * small.scan(world, T, k).points).astype(np.float32) for k, T in enumerate(poses)]
    faces = ScanFaces.of(found[0])
    seen = [[PosedScan(points, T, faces)] for points, T in zip(found, placed, strict=True)]
    points = [transform_points(p[::20].astype(float), T) for p, T in zip(found, placed, strict=True)]
    measured, places = np.concatenate(points), cKDTree([T[:3, 3] for T in placed])
    for voxel in (0.1, 0.2):
        maps, rates = fuse(seen, voxel, 40.0, 2 * voxel)
        line(f"64 rings, 2 cm, {100 * voxel:g} cm, far", maps, rates, None)
        vertices = maps.mesh(50).vertices.astype(float)
        off = 1e3 * LARGE * np.abs(world_distance(world, vertices / LARGE))
        missing = cKDTree(vertices).query(measured)[0] > voxel
        away, measured_away = places.query(vertices)[0], places.query(measured)[0]
        for low, high in pairwise(RANGES):
            here = off[(away >= low) & (away < high)]
            gaps = missing[(measured_away >= low) & (measured_away < high)]
            if not len(here):
                continue
            print(
                f"    {low:2} to {high:2} m: {len(here):7} vertices, off {np.median(here):.1f} mm (median), "
                f"{here.mean():.1f} (mean), {np.percentile(here, 95):.1f} (95 %); {100 * gaps.mean():.1f} % of the "
                "points have no mesh within a voxel", flush=True,
            )  # fmt: skip


def _scaled(T: np.ndarray) -> np.ndarray:
    placed = T.copy()
    placed[:3, 3] *= LARGE
    return placed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("scans", "cameras", "ranges")
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    parser.add_argument("--submaps", type=Path)
    a = parser.parse_args()
    if "scans" in a.parts:
        scans(a.submaps)
    if "cameras" in a.parts:
        cameras()
    if "ranges" in a.parts:
        ranges()


if __name__ == "__main__":
    main()
