#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""How fast a robot may drive on a live map: what `ggslam.volumes.safety` predicts against what a simulation finds.

    python scripts/benchmarks/bench_safety.py
    python scripts/benchmarks/bench_safety.py --quick
    python scripts/benchmarks/bench_safety.py --voxels 0.05 --latencies 50 --load 20

A robot drives along rooms and corridors of a generated world. Boxes, discs, poles and panels appear in its way, at the
protective distance or farther. Depth is rendered exactly, fused by `TsdfMap` with `DistanceField`, and the robot brakes
when the band of its heights has something within the protective distance. Simulated: motion, camera, and the latencies
of sensor and planner, which fill up what the map leaves of the latencies asked for. Measured: which frame gets an
obstacle into the map, where the map has it, and how long a frame takes in it (processor time of one thread, drawn for
each frame from those measured on this machine at the beginning, those of frames with a new obstacle apart). Where a map
takes longer than the latency asked for, the latency is what the map takes.

A second table leaves out one term of the prediction after the other, and counts the collisions that it costs.

Prints a table and writes safety.json and safety.png.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np
from safety_cells import FINE, Cell, Experiment, MapTimes, measure_map, run_cell
from safety_figure import draw_cells
from safety_terms import Term, try_terms

from ggslam.cli.console import console, table

FULL = 200, [0.1, 0.05, 0.02, 0.01], [16.0, 50.0, 100.0, 500.0]
"""Trials, voxels in metres, latencies in ms."""
QUICK = 60, [0.1, 0.05], [16.0, 100.0, 500.0]
COARSE = 0.05
"""Voxels, in metres, from which terms are left out one by one: with others it takes long and says the same."""


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voxels", nargs="+", type=float, help="metres")
    parser.add_argument("--latencies", nargs="+", type=float, help="ms")
    parser.add_argument("--trials", type=int)
    parser.add_argument("--distance", type=float, default=2.0, help="protective distance, metres")
    parser.add_argument("--load", type=float, default=0.0, help="kilograms that roll along unbraked")
    parser.add_argument("--noise", action="store_true", help="depth as a structured-light camera measures it")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="fewer trials, coarse voxels")
    parser.add_argument("--out", type=Path, default=Path("safety"), help="folder")
    arguments = parser.parse_args()
    usual = QUICK if arguments.quick else FULL
    trials, voxels, latencies = (
        given or default
        for given, default in zip((arguments.trials, arguments.voxels, arguments.latencies), usual, strict=True)
    )
    experiment = Experiment(trials=trials, distance=arguments.distance, noise=arguments.noise, seed=arguments.seed)
    experiment = replace(experiment, robot=replace(experiment.robot, load=arguments.load))
    start = time.perf_counter()
    cells, measured = run_all(experiment, voxels, latencies, arguments.workers)
    print_cells(cells, measured)
    terms = []
    if max(voxels) >= COARSE and not arguments.quick:
        terms = try_terms(experiment, max(voxels), measured[max(voxels)])
        print_terms(terms, experiment)
    arguments.out.mkdir(parents=True, exist_ok=True)
    written = {"cells": [asdict(cell) for cell in cells], "terms": [asdict(term) for term in terms],
               "experiment": asdict(experiment),
               "map": {f"{voxel:g}": _summary(times) for voxel, times in measured.items()}}  # fmt: skip
    (arguments.out / "safety.json").write_text(json.dumps(written, indent=1))
    draw_cells(cells, experiment.distance, arguments.out / "safety.png")
    console.print(f"wrote safety.json and safety.png to {arguments.out} after {time.perf_counter() - start:.0f} s")


def run_all(
    experiment: Experiment, voxels: list[float], latencies: list[float], workers: int
) -> tuple[list[Cell], dict[float, MapTimes]]:
    """All cells, those that take longest first, and the measured times of the maps. Latencies shorter than a map takes
    are one cell. The speed without waiting is not tried with fine voxels: it would take half as long again."""
    measured = {voxel: measure_map(experiment, voxel) for voxel in voxels}
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        running: dict[tuple[float, float], Future[Cell]] = {}
        for voxel in sorted(voxels):
            times = measured[voxel]
            for asked in (ms / 1e3 for ms in latencies):
                key = voxel, max(asked, times.latency)
                if key not in running:
                    running[key] = pool.submit(run_cell, experiment, voxel, asked, times, voxel >= FINE)
        for done in as_completed(running.values()):
            cell = done.result()
            line = f"{100 * cell.voxel:g} cm, {1e3 * cell.latency:.0f} ms: {cell.found:.2f} m/s"
            console.print(line, highlight=False)
        cells = [
            replace(running[voxel, max(ms / 1e3, times.latency)].result(), asked=ms / 1e3)
            for voxel, times in measured.items()
            for ms in latencies
        ]
    return sorted(cells, key=lambda cell: (-cell.voxel, cell.asked)), measured


def print_cells(cells: list[Cell], measured: dict[float, MapTimes]) -> None:
    """The table, and how the maps did."""
    rows = [
        [f"{100 * c.voxel:g} cm", f"{1e3 * c.asked:g}", f"{1e3 * c.map_latency:.1f}", f"{1e3 * c.latency:.0f}",
         f"{1e3 * c.total:.0f}", f"{c.found:.2f}", f"{c.predicted:.2f}", f"{100 * (c.predicted / c.found - 1):+.1f} %",
         f"{c.collisions}", f"{c.plain:.2f}", "-" if c.plain_collisions < 0 else f"{c.plain_collisions}"]
        for c in cells
    ]  # fmt: skip
    heads = ["voxel", "asked, ms", "map", "latency", "with waiting", "found, m/s", "predicted", "off", "collisions",
             "without waiting", "collisions"]  # fmt: skip
    console.print(table(f"largest speed without a collision in {cells[0].trials}", heads, rows))
    for voxel, times in measured.items():
        got = _summary(times)
        console.print(
            f"voxels of {100 * voxel:g} cm: a frame takes {got['calm']:.1f} ms (95 %: {got['calm_p95']:.1f}), with an "
            f"obstacle {got['news']:.1f} ms (95 %: {got['news_p95']:.1f}); something in the way of a free lane in "
            f"{times.false_stops} of {len(times.calm)} frames",
            highlight=False,
        )  # fmt: skip


def print_terms(terms: list[Term], experiment: Experiment) -> None:
    """What each term of the prediction is worth."""
    rows = [[t.name, f"{t.speed:.2f}", f"{t.collisions}"] for t in terms]
    title = f"speed, and collisions in {experiment.trials}"
    console.print(table(title, ["predicted with", "m/s", "collisions"], rows))


def _summary(times: MapTimes) -> dict[str, float]:
    groups = {"calm": 1e3 * times.calm, "news": 1e3 * times.news}
    found = {name: float(ms.mean()) for name, ms in groups.items()}
    found |= {f"{name}_p95": float(np.percentile(ms, 95)) for name, ms in groups.items()}
    return found | {"false_stops": times.false_stops}


if __name__ == "__main__":
    main()
