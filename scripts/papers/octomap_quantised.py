# SPDX-License-Identifier: Apache-2.0
"""The tables of the paper on voxel-quantised updates of OctoMap, with ours beside them.

    python scripts/papers/octomap_quantised.py [--data FOLDER] [--quick]

One ray a voxel instead of one a point, against `insertPointCloud` of OctoMap itself (pyoctomap), on frames of a
recording with true poses; agreement with the update by every point after more frames; figure 5 as a picture of one
height at 1, 2 and 4 cm, unquantised above quantised; and paths a second planned on the recordings' maps and on a
generated one.
"""

from __future__ import annotations

import importlib.util
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import find_benchmarks  # noqa: F401  # isort: skip
from rows import Paper, options

from agreement import agreement  # isort: skip
from bench_occupancy import Scan, load_scans, milliseconds  # isort: skip
from bench_planner import HEIGHTS, OCTOMAPS, clearance_of, fill_place, open_octomap, plan_pairs  # isort: skip
from ggslam.driving.plan_settings import PlanSettings
from ggslam.driving.robot import Robot
from ggslam.jobs.plan.map_files import MapRequest, open_plan_map
from ggslam.native.loader import NativeContext
from ggslam.reporting.pictures import side_by_side, write_picture
from ggslam.system.atomic import make_folder
from ggslam.volumes.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyMap
from ggslam.volumes.occupancy_settings import OccupancySettings
from ggslam.volumes.octomap_files import write_octomap

Pairs = dict[float, tuple[OccupancyMap, OccupancyMap]]
"""Maps by the edge of their voxels: a ray for every point, and quantised."""
BAR_M = 0.5
"""Length of the bar of scale."""
PLAN_VOXEL, PLAN_CLEARANCE = 0.05, 0.1
"""Of ways on the map of a recording, metres."""
RECORDINGS = ("redkitchen", "livingroom")
COLOURS = {UNKNOWN: (200, 200, 200), FREE: (255, 255, 255), OCCUPIED: (30, 30, 60)}
SHOWN = (0.04, 0.02, 0.01)
"""Edges of voxels that figure 5 shows, metres."""


def add_times(paper: Paper, name: str, scans: list[Scan], voxels: list[float], context: NativeContext) -> None:
    """Milliseconds a frame: OctoMap, point by point and by its own `discretize`, and ours."""
    if importlib.util.find_spec("pyoctomap") is None:
        paper.add("time a frame", name, "", "", "needs pyoctomap: pip install 'ggslam[volumes]'")
        return
    import pyoctomap


    def insert_plain(tree: Any, scan: Scan) -> None:
        tree.insertPointCloud(scan.wide_points, scan.wide_origin)

    def insert_discrete(tree: Any, scan: Scan) -> None:
        tree.insertPointCloud(scan.wide_points, scan.wide_origin, discretize=True)

    def insert(ours: OccupancyMap, scan: Scan) -> None:
        ours.insert(scan.points, scan.origin)

    for voxel in voxels:
        tree, own = partial(pyoctomap.OcTree, voxel), partial(OccupancyMap, voxel, context=context)
        raw, _ = milliseconds(tree, insert_plain, scans, 1.0)
        theirs, _ = milliseconds(tree, insert_discrete, scans, 1.0)
        ours, _ = milliseconds(own, insert, scans, 1.0)
        points = round(float(np.mean([len(scan.points) for scan in scans])), -3)
        paper.add(
            "time a frame", f"{name}, {points:.0f} points, {100 * voxel:g} cm", "up to 45x",
            f"{raw / ours:.0f}x ({raw:.0f} to {ours:.1f} ms)",
            f"of OctoMap with every point, one thread; ours {context.threads}; its discretize {raw / theirs:.1f}x",
        )  # fmt: skip


def add_agreement(
    paper: Paper, name: str, scans: list[Scan], voxels: list[float], context: NativeContext
) -> Pairs:
    """How far the quantised map is that of every point, as the paper counts; the maps of voxels to show."""
    maps = {}
    for voxel in voxels:
        every, ours = (OccupancyMap(voxel, OccupancySettings(quantize=quantize), context) for quantize in (False, True))
        for scan in scans:
            every.insert(scan.points, scan.origin)
            ours.insert(scan.points, scan.origin)
        found = agreement(every, ours)
        paper.add(
            "agreement", f"{name}, {len(scans)} frames, {100 * voxel:g} cm", "94 % at least",
            f"{100 * found.known:.1f} %", f"of voxels known to both; {100 * found.union:.1f} % of all known",
        )  # fmt: skip
        if voxel in SHOWN:
            maps[voxel] = every, ours
    return maps


def picture(one: OccupancyMap, centre: np.ndarray, label: str, size_m: float = 3.0, pixels: int = 480) -> np.ndarray:
    """A map at the height of a place [3], [h, w, 3] uint8: white is free, dark occupied, grey unknown; with a label and
    a bar of half a metre."""
    steps = (np.arange(pixels) / pixels - 0.5) * size_m
    across, along = np.meshgrid(steps, steps)
    points = (centre + np.stack([across, np.zeros_like(across), along], -1)).reshape(-1, 3).astype(np.float32)
    states = one.states(points)
    image = np.zeros((len(states), 3), np.uint8)
    for state, colour in COLOURS.items():
        image[states == state] = colour
    caption, bar = np.full((40, pixels, 3), 255, np.uint8), round(BAR_M / size_m * pixels)
    cv2.putText(caption, label, (8, 27), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
    caption[18:23, pixels - 70 - bar : pixels - 70] = 0
    cv2.putText(caption, f"{BAR_M:g} m", (pixels - 62, 27), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([caption, image.reshape(pixels, pixels, 3)])


def add_picture(paper: Paper, name: str, pairs: Pairs, centre: np.ndarray, out: Path) -> None:
    """Figure 5: a column for each edge of voxels, above with a ray for every point, below quantised."""
    rows = [
        side_by_side([picture(pair[row], centre, f"{100 * voxel:g} cm, {words}") for voxel, pair in pairs.items()])
        for row, words in enumerate(("every point", "quantised"))
    ]
    path = out / f"octomap_{name}.png"
    write_picture(path, np.concatenate(rows))
    sizes = ", ".join(f"{100 * voxel:g}" for voxel in pairs)
    paper.show(path, f"Figure 5, {name}, {sizes} cm, at one height; above a ray for every point, below quantised")


def add_paths(paper: Paper, quick: bool) -> None:
    """Paths a second on a generated place of the size of a published map."""
    name, (size, voxel, things) = next(iter(OCTOMAPS.items()))
    if quick:
        size, things = (12.0, 8.0, 3.0), 12
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.bt"
        write_octomap(fill_place(size, voxel, things), path)
        for fly, height in HEIGHTS.items():
            found = plan_pairs(open_octomap(path, voxel, fly), clearance_of(voxel), size, height)
            where = f"{'space' if fly else 'floor'}, {' x '.join(f'{s:g}' for s in size)} m, {100 * voxel:g} cm"
            paper.add(
                "planning", where, "", f"{found.paths_per_s:.0f} paths/s",
                f"{len(found.ms)} of {len(found.cold_ms)} pairs joined; a generated stand-in {name}, read from .bt",
            )  # fmt: skip


def add_recorded_paths(paper: Paper, name: str, scans: list[Scan], context: NativeContext) -> None:
    """Ways in space a second on the map that the quantised updates of a recording, y down, made; at the height of the
    camera, between places within what the map holds around it."""
    quantised = OccupancyMap(PLAN_VOXEL, context=context)
    turn = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32)
    for scan in scans:
        quantised.insert(scan.points @ turn.T, turn @ scan.origin)
    low, high = np.percentile(np.concatenate([scan.points[::50] for scan in scans]) @ turn.T, [10, 90], axis=0).tolist()
    size = high[0] - low[0], high[1] - low[1], high[2] - low[2]
    height = float(np.median([turn @ scan.origin for scan in scans], 0)[2])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.bt"
        write_octomap(quantised, path)
        request = MapRequest(path, Robot(0.2, PLAN_CLEARANCE), True, PLAN_CLEARANCE, PlanSettings(), np.zeros(3))
        plan_map = open_plan_map(request)
        found = plan_pairs(plan_map, PLAN_CLEARANCE, size, height, 200, (low[0], low[1]))
    paper.add(
        "planning", f"space, {name}, {len(scans)} frames, {100 * PLAN_VOXEL:g} cm", "",
        f"{found.paths_per_s:.0f} paths/s" if found.ms else "",
        f"{len(found.ms)} of {len(found.cold_ms)} pairs joined; made by quantised updates of the recording, read from "
        f".bt; clearance {PLAN_CLEARANCE:g} m",
    )  # fmt: skip


def main() -> None:
    arguments = options(__doc__).parse_args()
    quick, context = arguments.quick, NativeContext()
    make_folder(arguments.out)
    paper = Paper(
        "octomap_quantised", "Voxel-quantised OctoMap",
        f"{context.threads} threads; frames of 640x480 at the recordings' true poses.",
    )  # fmt: skip
    voxels = [0.08, 0.04] if quick else [0.16, 0.08, 0.04, 0.02, 0.01]
    for name in [n for n in RECORDINGS if (arguments.data / n).exists()]:
        add_times(paper, name, list(load_scans(arguments.data / name, 1 if quick else 3)), voxels, context)
        scans = list(load_scans(arguments.data / name, 4 if quick else 20))
        maps = add_agreement(paper, name, scans, voxels, context)
        add_recorded_paths(paper, name, scans, context)
        add_picture(paper, name, maps, np.median(scans[len(scans) // 2].points, 0), arguments.out)
    if not paper.rows:
        raise SystemExit(f"{arguments.data}: none of {', '.join(RECORDINGS)}")
    add_paths(paper, quick)
    paper.write(arguments.out)


if __name__ == "__main__":
    main()
