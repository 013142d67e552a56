#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Inserts the frames of a recording, with their true poses, into occupancy maps and prints how long a frame takes.

    python scripts/benchmarks/bench_occupancy.py ../shared/data/redkitchen
    python scripts/benchmarks/bench_occupancy.py ../shared/data/livingroom --voxels 0.08 0.02 --frames 5
    python scripts/benchmarks/bench_occupancy.py --weights --voxels 0.1 0.05

Ways (all but the last two into a tree of pyoctomap):
    raw        insertPointCloud with every point: the reference, and the map that agreement is measured against
    discretize insertPointCloud with discretize=True
    quantised  the voxel centres that `quantize` gives, through insertPointCloud
    batched    `insert_batched`: the scan's voxels found natively, the tree updated voxel by voxel
    rebuilt    `insert_rebuilding`: tree to native map, native insertion, new tree
    native     `OccupancyMap.insert`
    every      `OccupancyMap.insert` with quantize=False

Times are milliseconds a frame: means over the frames of each frame's fastest run, in the same process; in brackets how
many times faster than raw. Like for like, which a line of its own has: `every` against raw (a ray for every point), and
native against the faster of discretize and quantised (a ray for every voxel). OctoMap uses one thread, ours as many as
the first line says (--threads). The maps of all ways but raw and `every` must be equal byte for byte, and so must those
two; a line tells if they are not.

With --weights: what it brings to count a voxel's points, see occupancy_weights.py; takes no recording.

Agreement is that of the quantised with the unquantised map, both native, after more frames: equal voxels among those
known to both / known to either, with OctoMap's log-odds and with the raised ones in the quantised map.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "volumes"))

import numpy as np
from agreement import agreement
from occupancy_weights import print_weights
from pyoctomap_bridge import insert_batched, insert_rebuilding

from ggslam.native.loader import NativeContext
from ggslam.scene.poses import transform_points
from ggslam.sequences.factory import open_sequence
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.occupancy_settings import OccupancySettings
from ggslam.volumes.octomap_files import full_octomap
from ggslam.volumes.quantization import quantize


@dataclass(frozen=True)
class Scan:
    """Points [N, 3] and sensor [3] in the world, in both precisions: pyoctomap takes float64 only."""

    points: np.ndarray
    origin: np.ndarray
    wide_points: np.ndarray
    wide_origin: np.ndarray


def load_scans(recording: Path, frames: int) -> Iterator[Scan]:
    """As many frames, evenly spread over the recording."""
    sequence = open_sequence(recording)
    for index in np.linspace(0, len(sequence) - 1, frames + 2).astype(int)[1:-1]:
        frame = sequence.frame(int(index))
        if frame.T_world_camera is None:
            sys.exit(f"{recording}: frame {index} has no true pose")
        points = frame.camera.back_project(frame.depth)[frame.depth > 0]
        world = transform_points(points, frame.T_world_camera).astype(np.float32)
        origin = frame.T_world_camera[:3, 3].astype(np.float32)
        yield Scan(world, origin, world.astype(np.float64), origin.astype(np.float64))


def milliseconds(
    start: Callable[[], Any], insert: Callable[[Any, Scan], Any], scans: list[Scan], budget: float, most: int = 7
) -> tuple[float, Any]:
    """Mean over the scans of the fastest of several runs, each with a new map, and the last map."""
    runs: list[list[float]] = []
    began = time.perf_counter()
    while not runs or (len(runs) < most and time.perf_counter() - began < budget):
        target, times = start(), []
        for scan in scans:
            before = time.perf_counter()
            target = insert(target, scan) or target
            times.append(time.perf_counter() - before)
        runs.append(times)
    return 1000 * float(np.mean(np.min(runs, axis=0))), target


def bench(voxel: float, scans: list[Scan], context: NativeContext, budget: float) -> None:
    import pyoctomap

    def tree() -> Any:
        return pyoctomap.OcTree(voxel)

    def native() -> OccupancyMap:
        return OccupancyMap(voxel, context=context)

    def plain(target: Any, points: np.ndarray, scan: Scan, **options: bool) -> None:
        target.insertPointCloud(points, scan.wide_origin, **options)

    def quantised(target: Any, scan: Scan) -> None:
        plain(target, quantize(scan.points, voxel, context).centers().astype(np.float64), scan)

    def into_native(target: OccupancyMap, scan: Scan) -> None:
        target.insert(scan.points, scan.origin)

    def batched(target: Any, scan: Scan) -> None:
        insert_batched(target, scan.points, scan.origin, context=context)

    def rebuilt(target: Any, scan: Scan) -> Any:
        return insert_rebuilding(target, scan.points, scan.origin, context=context)

    def every_point() -> OccupancyMap:
        return OccupancyMap(voxel, OccupancySettings(quantize=False), context)

    raw, raw_tree = milliseconds(tree, lambda t, s: plain(t, s.wide_points, s), scans, budget)
    ways = [
        milliseconds(tree, lambda t, s: plain(t, s.wide_points, s, discretize=True), scans, budget),
        milliseconds(tree, quantised, scans, budget),
        milliseconds(tree, batched, scans, budget),
        milliseconds(tree, rebuilt, scans, budget),
        milliseconds(native, into_native, scans, budget),
        milliseconds(every_point, into_native, scans, budget),
    ]
    ours, reference = ways[-2][1], ways[-1][1]
    times = [time for time, _ in ways]
    cells = "".join(f"{time:8.1f} ({raw / time:5.1f}x)" for time in times)
    print(f"{100 * voxel:4g} cm {raw:9.1f}{cells}", flush=True)
    print(
        f"        like for like: a ray for every point {raw / times[-1]:.1f}x, for every voxel "
        f"{min(times[:2]) / times[-2]:.1f}x; between the two {raw / times[-2]:.1f}x"
    )
    same = all(full_octomap(ours) == way_tree.write() for _, way_tree in ways[:-2])
    if not same or full_octomap(reference) != raw_tree.write():
        print("        the maps of the ways differ")
    size = ours.summary()
    print(
        f"        {size.free + size.occupied} voxels known, {size.blocks} blocks, {size.memory_bytes / 1e6:.1f} MB; "
        f"pyoctomap {ways[0][1].memoryUsage() / 1e6:.1f} MB"
    )


def print_agreement(voxel: float, recording: Path, frames: int, context: NativeContext) -> None:
    settings = [OccupancySettings(quantize=False), OccupancySettings(), OccupancySettings.with_raised_odds()]
    reference, *others = (OccupancyMap(voxel, s, context) for s in settings)
    for scan in load_scans(recording, frames):
        for target in (reference, *others):
            target.insert(scan.points, scan.origin)
    found = [agreement(reference, other) for other in others]
    shares = "   ".join(
        f"{name} {a.known:.4f} / {a.union:.4f}" for name, a in zip(("plain", "raised"), found, strict=True)
    )
    print(f"{100 * voxel:4g} cm   {shares}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, nargs="?")
    parser.add_argument("--weights", action="store_true", help="the table of occupancy_weights.py alone")
    parser.add_argument("--voxels", type=float, nargs="+", default=[0.16, 0.08, 0.04, 0.02, 0.01], help="metres")
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--agreement-frames", type=int, default=40)
    parser.add_argument("--budget", type=float, default=3.0, help="seconds for the runs of one way")
    parser.add_argument("--threads", type=int, help="of our ways; default: one per processor")
    arguments = parser.parse_args()
    context = NativeContext(arguments.threads)
    if arguments.weights:
        for voxel in arguments.voxels:
            print_weights(voxel, context)
        return
    if arguments.recording is None:
        parser.error("expected a recording, or --weights")
    scans = list(load_scans(arguments.recording, arguments.frames))
    sizes = ", ".join(str(len(scan.points)) for scan in scans)
    print(f"{len(scans)} frames of {sizes} points, {context.threads} threads")
    ways = "".join(f"{way:>17}" for way in ("discretize", "quantised", "batched", "rebuilt", "native", "every"))
    print(f"  voxel       raw{ways}")
    for voxel in arguments.voxels:
        bench(voxel, scans, context, arguments.budget)
    print(f"agreement after {arguments.agreement_frames} frames: known to both / known to either")
    for voxel in arguments.voxels:
        print_agreement(voxel, arguments.recording, arguments.agreement_frames, context)


if __name__ == "__main__":
    main()
