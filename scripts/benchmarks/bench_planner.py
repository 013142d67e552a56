# SPDX-License-Identifier: Apache-2.0
"""Paths through generated rooms of exact geometry: found, clear, short, and how long planning takes.

    python scripts/benchmarks/bench_planner.py                      # everything, half an hour
    python scripts/benchmarks/bench_planner.py --parts replans

Parts:

    rooms     200 pairs on the floor and 200 in space, against the exact rooms and scipy's shortest ways
    trade     the same pairs on the floor with other weights of the clearance
    replans   an obstacle appears on the way: taking it in and planning again, on 10 x 10 m at 5 and 2 cm and in space
    octomap   stand-ins of the sizes of published OctoMaps (FR-079 at 5 cm, Freiburg campus and New College at 20 cm):
              generated rooms filled by scans, written as .bt and .ot, and read back as `ggslam plan` reads maps
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(1, str(Path(__file__).parents[2] / "tests" / "driving"))

import numpy as np  # noqa: E402
from plan_scenes import Room, Trial, random_room, room_planner, trials  # noqa: E402

from ggslam.driving.plan_maps import PlanMap  # noqa: E402
from ggslam.driving.plan_settings import PlanSettings  # noqa: E402
from ggslam.driving.planner import Planner  # noqa: E402
from ggslam.driving.robot import Robot  # noqa: E402
from ggslam.jobs.plan.map_files import MapRequest, open_plan_map  # noqa: E402
from ggslam.volumes.occupancy import OccupancyMap  # noqa: E402
from ggslam.volumes.octomap_files import write_octomap  # noqa: E402

ASKED = 0.25
"""Least clearance, metres."""
FLOOR, SPACE = (10.0, 10.0, 2.5), (5.0, 5.0, 2.5)
"""Sizes of the rooms for who drives and who flies, metres."""
OCTOMAPS = {
    "as FR-079 corridor": ((43.8, 18.2, 3.3), 0.05, 60),
    "as Freiburg campus": ((292.0, 167.0, 28.0), 0.2, 120),
    "as New College": ((250.0, 161.0, 33.0), 0.2, 120),
}
"""Size in metres, voxel, and things in it, of generated places as large as the maps that OctoMap's paper measures."""
HEIGHTS = {False: 0.0, True: 1.5}
"""Metres above the floor of ways on OctoMaps, by whether they fly."""


def main() -> None:
    """Runs the parts that are asked for."""
    parts: dict[str, Callable[[], None]] = {"rooms": rooms, "trade": trade, "replans": replans, "octomap": octomaps}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=list(parts), default=list(parts))
    for name in parser.parse_args().parts:
        print(f"{name}:", flush=True)
        parts[name]()


def rooms() -> None:
    """Pairs on the floor and in space."""
    floor = [(random_room(seed, FLOOR, 3, 25), seed) for seed in range(10)]
    print_trials("floor, 5 cm", [t for room, seed in floor for t in _flat(room, seed, PlanSettings())])
    space = []
    for seed in range(10):
        room = random_room(seed, SPACE, 2, 15)
        space += trials(room_planner(room, 0.05, True, ASKED), room, seed, 2, 10)
    print_trials("space, 5 cm", space)


def trade() -> None:
    """Length and clearance by the weight."""
    for weight in (0.0, PlanSettings.weight, 0.1, 0.3, 1.0):
        found = []
        for seed in range(5):
            found += _flat(random_room(seed, FLOOR, 3, 25), seed, PlanSettings(weight=weight))
        print_trials(f"floor, weight {weight:g}", found)


def _flat(room: Room, seed: int, settings: PlanSettings) -> list[Trial]:
    return trials(room_planner(room, 0.05, False, ASKED, settings), room, seed, 4, 5)


def print_trials(name: str, found: list[Trial]) -> None:
    """What came of pairs."""
    exist, there = [t for t in found if t.exists], [t for t in found if t.found]
    ratio = np.array([t.ratio for t in exist if t.found])
    spare = -1e3 * np.array([t.missing for t in there])
    print(
        f"  {name}: {len(found)} pairs, {len(exist)} have a way, {sum(t.found for t in exist)} of them found, "
        f"{sum(not t.exists for t in there)} found where none is\n"
        f"    length / shortest over cells: mean {ratio.mean():.3f}, largest {ratio.max():.3f}; exact clearance above "
        f"the one asked: mean {spare.mean():.0f}, least {spare.min():.1f} mm; CPU ms: "
        f"{_spread(np.array([t.milliseconds for t in there]))}",
        flush=True,
    )


def _spread(values: np.ndarray) -> str:
    if not len(values):
        return "none"
    return f"mean {values.mean():.2f}, 95 % {np.percentile(values, 95):.2f}, largest {values.max():.2f}"


def replans() -> None:
    """An obstacle of 40 cm appears in the middle of a path; from a third of it a new one is planned."""
    for name, fly, voxel, rooms_ in (
        ("floor 10 x 10 m, 5 cm", False, 0.05, 4), ("floor 10 x 10 m, 2 cm", False, 0.02, 2),
        ("space 10 x 10 x 2.5 m, 5 cm", True, 0.05, 10),
    ):  # fmt: skip
        found: list[tuple[float, float, bool]] = []
        for seed in range(rooms_):
            planner = room_planner(random_room(seed, FLOOR, 3, 25), voxel, fly, ASKED)
            rng = np.random.default_rng(seed)
            found += [times for times in (_replan(planner, rng) for _ in range(60)) if times is not None]
        taken, planned = np.array([t for t, _, _ in found]), np.array([p for _, p, _ in found])
        there = np.array([way for _, _, way in found])
        print(
            f"  {name}: {len(found)} obstacles, {there.sum()} leave a way; CPU ms to take one in: {_spread(taken)}\n"
            f"    and to find the way: {_spread((taken + planned)[there])}\n"
            f"    or that there is none: {_spread((taken + planned)[~there])}",
            flush=True,
        )


def _replan(planner: Planner, rng: np.random.Generator) -> tuple[float, float, bool] | None:
    """CPU ms of taking in an obstacle and of planning again, and whether there still is a way; None: there was no path,
    or a short one. The obstacle goes again."""
    start, goal = rng.uniform(0.3, np.array(FLOOR) - 0.3, (2, 3))
    before = planner.plan(start, goal, explain=False)
    if not before.is_found or before.length < 2:
        return None
    middle, here = (before.points[int(len(before.points) * share)] for share in (0.55, 0.3))
    step = np.arange(-0.2, 0.2, planner.map.cell)
    height = step if planner.map.dimensions == 3 else np.zeros(1)
    block = middle + np.stack(np.meshgrid(step, step, height), -1).reshape(-1, 3)
    reach = 0.2 + planner.costs.radius + planner.costs.margin + 4 * planner.map.cell
    low, high = planner.grid.cells_of(planner.map.to_grid(np.array([middle - reach, middle + reach])))
    first = (int(low[0]), int(low[1]), int(low[2]))
    held = planner.grid.read(first, tuple((high - low + 1)[: planner.map.dimensions][::-1].tolist()))
    began = time.process_time()
    planner.add_obstacles(block)
    taken = time.process_time()
    after = planner.plan(here, goal, explain=False)
    done = time.process_time()
    planner.update(first, held)
    return 1e3 * (taken - began), 1e3 * (done - taken), after.is_found


def octomaps() -> None:
    """Paths per second on large occupancy maps, of files."""
    for name, (size, voxel, things) in OCTOMAPS.items():
        began = time.process_time()
        occupancy = fill_place(size, voxel, things)
        found = occupancy.summary()
        print(
            f"  {name}, {size[0]:g} x {size[1]:g} x {size[2]:g} m, {100 * voxel:g} cm: {found.occupied} occupied and "
            f"{found.free} free voxels, {found.memory_bytes / 1e6:.0f} MB ({time.process_time() - began:.0f} s)",
            flush=True,
        )
        with tempfile.TemporaryDirectory() as folder:
            for ending in (".bt", ".ot"):
                _of_file(name, occupancy, Path(folder) / f"map{ending}", size, voxel)


def _of_file(name: str, occupancy: OccupancyMap, path: Path, size: tuple[float, float, float], voxel: float) -> None:
    """Writes a map and plans on what is read; in space on the binary one only, which both kinds are the same for."""
    write_octomap(occupancy, path)
    clearance = clearance_of(voxel)
    for fly in (False, True) if path.suffix == ".bt" else (False,):
        began = time.process_time()
        plan_map = open_octomap(path, voxel, fly)
        print(
            f"    {path.suffix}, {path.stat().st_size / 1e6:.1f} MB, read in {time.process_time() - began:.1f} s; "
            f"{_paths(plan_map, clearance, size, HEIGHTS[fly])}",
            flush=True,
        )


def clearance_of(voxel: float) -> float:
    """Metres that ways on an OctoMap keep from obstacles."""
    return max(0.3, 1.5 * voxel)


def open_octomap(path: Path, voxel: float, fly: bool) -> PlanMap:
    """An OctoMap's file, for ways on the floor or in space."""
    clearance = clearance_of(voxel)
    robot, start = Robot(height=0.6, radius=clearance), np.array([0.0, 0.0, HEIGHTS[fly]])
    return open_plan_map(MapRequest(path, robot, fly, clearance, PlanSettings(), start))


def fill_place(size: tuple[float, float, float], voxel: float, things: int) -> OccupancyMap:
    """A map of a place with things in it, by scans from a raster of positions."""
    room, occupancy = random_room(1, size, 0, things), OccupancyMap(voxel)
    rng, apart = np.random.default_rng(0), 4.0 if size[0] < 100 else 12.0
    for x in np.arange(apart / 2, size[0], apart):
        for y in np.arange(apart / 2, size[1], apart):
            eye = np.array([x, y, 1.2])
            if room.distance(eye[None])[0] < 0.3:
                continue
            way = rng.normal(size=(6000, 3)) * (1, 1, 0.3)
            way /= np.linalg.norm(way, axis=1, keepdims=True)
            far, going = np.zeros(len(way)), np.arange(len(way))
            for _ in range(80):  # as far as nothing can be
                step = np.maximum(room.distance(eye + far[going, None] * way[going]), 0)
                far[going] += step
                going = going[(step > voxel / 100) & (far[going] < 30)]
            occupancy.insert(eye + far[:, None] * way, eye, 30.0)
    return occupancy


@dataclass(frozen=True)
class PairTimes:
    """What planning between random pairs took, processor time: of each found path in milliseconds and metres, of every
    pair the first time in milliseconds, with pages that were read for it."""

    ms: list[float]
    lengths_m: list[float]
    cold_ms: list[float]
    pages: int
    memory_bytes: int

    @property
    def paths_per_s(self) -> float:
        """Once every page is read; 0 if no pair is joined."""
        return 1e3 / float(np.mean(self.ms)) if self.ms else 0.0


def plan_pairs(
    plan_map: PlanMap, clearance: float, size: tuple[float, float, float], height: float, pairs: int = 60,
    corner: tuple[float, float] = (0.0, 0.0),
) -> PairTimes:  # fmt: skip
    """Plans between random pairs at a height, `corner` and more, each again until no page of the map is read for it."""
    planner, rng = Planner(plan_map, clearance), np.random.default_rng(0)
    ms, lengths, cold = [], [], []
    for _ in range(pairs):
        ends = rng.uniform(0, size, (2, 3))
        ends[:, :2] += corner
        ends[:, 2] = height
        began = time.process_time()
        path = planner.plan(ends[0], ends[1], explain=False)
        cold.append(1e3 * (time.process_time() - began))
        for _ in range(6 if path.is_found else 0):
            planner.grid.write((0, 0, 0), planner.grid.read((0, 0, 0), (1,) * plan_map.dimensions))  # forgets the goal
            began = time.process_time()
            path = planner.plan(ends[0], ends[1])
            took = time.process_time() - began
            if path.pages == 0:
                ms.append(1e3 * took)
                lengths.append(path.length)
                break
    return PairTimes(ms, lengths, cold, planner.pages, planner.grid.memory_bytes)


def _paths(plan_map: PlanMap, clearance: float, size: tuple[float, float, float], height: float) -> str:
    found = plan_pairs(plan_map, clearance, size, height)
    where = "space" if plan_map.dimensions == 3 else "floor"
    if not found.ms:
        return f"{where}: no path between {len(found.cold_ms)} pairs"
    return (
        f"{where}: {len(found.ms)} paths of {np.mean(found.lengths_m):.0f} m in the mean; CPU ms: "
        f"{_spread(np.array(found.ms))}, {found.paths_per_s:.0f} paths/s; {found.pages} pages read in all, "
        f"{found.memory_bytes / 1e6:.0f} MB; the first time, with reading, {np.mean(found.cold_ms):.0f} ms"
    )


if __name__ == "__main__":
    main()
