#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Localisation in partial maps against whole ones: points, time, accuracy, memory; printed as ratios.

    python scripts/benchmarks/bench_submaps.py --folder /tmp/worlds
    python scripts/benchmarks/bench_submaps.py --folder /tmp/worlds --parts kitchen --recording data/redkitchen

Parts:
    worlds    a generated world of SIZE x SIZE metres and one of ten times its area, each with a laser scanner carried
              through it: partial and full map. (The full map of the large one takes 9 GB of memory;
              --no-large-full leaves it out, and it is left out where that is not free.)
    kitchen   a recording: map from its first frames with their true poses, the rest is located
    store     what cells cost, and partial maps against reading all (scripts/benchmarks/bench_grid_store.py)
    kills     a writer of cells is killed again and again (tests/submaps/test_killed_writer.py)

Every case is a process of its own (submap_runs.py); cases that are compared are measured in turns. All
repetitions of a case do the same work frame by frame: of each frame the least time counts.

    reading          seconds until the map is ready for the first frame: reading it, making what is aligned to
    everything       milliseconds a frame, over all frames, the first one with the reading, and every cell that is
                     entered: what a recording takes in all, divided by its frames
    once read        the same without the first frame: what a sensor that is on its way waits for, cells included
    worst            the slowest frame once the map is read
    aligning         of it the mean share of the frame itself, without the map
    processor        milliseconds of work a frame of all threads once the map is read, loading ahead included

The k-d tree is the named reference (kdtree_gicp.py): G-ICP to the nearest of all points, as is common.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
_BYTES_A_POINT = 225
"""Of a whole map while its target is made: half as much again as was measured with 4.3 million points."""
VOXELS, TREE = "voxels", "k-d tree"

Found = dict[str, Any]
Case = tuple[str, str, bool]
"""World or room, what is aligned to, whether it is the whole map."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="for worlds; those that are there are used again")
    parts = ("worlds", "kitchen", "store", "kills")
    parser.add_argument("--parts", nargs="+", choices=parts, default=list(parts))
    parser.add_argument("--size", type=float, default=100.0, help="metres")
    parser.add_argument("--spacing", type=float, default=0.1, help="metres between the map's points")
    parser.add_argument("--scans", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--voxel", type=float, default=0.15, help="of the target, metres")
    parser.add_argument("--radius", type=float, default=10.0, help="R', metres")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--no-large-full", action="store_true")
    parser.add_argument("--recording", type=Path, help="of part kitchen, an RGB-D recording with poses")
    parser.add_argument("--map-frames", type=int, default=150)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    if "worlds" in arguments.parts:
        worlds(arguments)
    if "kitchen" in arguments.parts and arguments.recording is not None:
        kitchen(arguments)
    if "store" in arguments.parts:
        print("\nstore (bench_grid_store.py)", flush=True)
        subprocess.run(
            [sys.executable, HERE / "bench_grid_store.py", "--folder", arguments.folder / "grids"], check=True
        )
    if "kills" in arguments.parts:
        kills()


def worlds(a: argparse.Namespace) -> None:
    """Prints both worlds, partial against full, and large against small."""
    made = {"1x": made_world(a, "1x", a.size), "10x": made_world(a, "10x", a.size * 10**0.5)}
    cases = [(name, method, full) for name in made for method in (VOXELS, TREE) for full in (False, True)]
    scarce = made["10x"]["points"] * _BYTES_A_POINT > available_bytes()
    if a.no_large_full or scarce:
        cases = [case for case in cases if case[0] != "10x" or not case[2]]
        print("10x, full map: left out" + (", there is too little free memory" if scarce else ""))
    options = ["--voxel", a.voxel, "--radius", a.radius]
    runs = measured({case: [a.folder / case[0] / "map.grid", a.folder / case[0], *options] for case in cases}, a.repeat)
    print(f"\nlocalisation of {a.scans} scans, voxels of {a.voxel:g} m, R' {a.radius:g} m")
    table(runs)
    for name in made:
        for method in (VOXELS, TREE):
            if (name, method, True) in runs:
                compare(f"{name}, {method}", runs[name, method, False], runs[name, method, True])
        if (name, TREE, True) in runs:
            print("our partial map against the reference's full one:")
            compare(name, runs[name, VOXELS, False], runs[name, TREE, True])
    for method in (VOXELS, TREE):
        for full in (False, True):
            if ("10x", method, full) in runs:
                what = f"{method}, {'full' if full else 'partial'} map"
                growth(what, runs["1x", method, full], runs["10x", method, full])


def made_world(a: argparse.Namespace, name: str, size: float) -> Found:
    """Makes a world, unless it is there."""
    folder = a.folder / name
    wanted = {"size": size, "spacing": a.spacing, "scans": a.scans, "seed": a.seed}
    note = folder / "made.json"
    if note.is_file() and (found := json.loads(note.read_text()))["wanted"] == wanted:
        return found
    options = [text for key, value in wanted.items() for text in (f"--{key}", value)]
    found = {**case("world", folder, *options), "wanted": wanted}
    note.write_text(json.dumps(found))
    print(
        f"{name}: {size:.0f} x {size:.0f} m, {found['points']} points, {found['cells']} cells, made in "
        f"{found['seconds']:.0f} s", flush=True,
    )  # fmt: skip
    return found


def kitchen(a: argparse.Namespace) -> None:
    """Prints partial against full map on a recording."""
    folder = a.folder / "kitchen"
    found = case("room", folder, "--recording", a.recording, "--stop", a.map_frames)
    size = f"{found['points']} points, {found['cells']} cells"
    print(f"\n{a.recording.name}: map of frames 0 to {a.map_frames - 1} with their true poses, {size}")
    # In one room everything is near; a smaller R' shows what leaving most of it out costs.
    for radius in (10.0, 2.0):
        command = [folder / "map.grid", a.recording, "--voxel", 0.03, "--radius", radius, "--first", a.map_frames]
        name = f"R' {radius:g} m"
        runs = measured({(name, VOXELS, full): command for full in (False, True)}, a.repeat)
        table(runs)
        compare(name, runs[name, VOXELS, False], runs[name, VOXELS, True])


def kills() -> None:
    """Prints what came of killing a writer 100 times."""
    print("\nkilling a writer of cells (tests/submaps/test_killed_writer.py)", flush=True)
    test = HERE.parents[1] / "tests/submaps/test_killed_writer.py"
    subprocess.run([sys.executable, "-m", "pytest", "-q", "-s", "-m", "slow", test], check=True)


def measured(cases: dict[Case, list[Any]], repeat: int) -> dict[Case, Found]:
    """Several runs of each case in turns, put together by the least time of each frame."""
    runs: dict[Case, list[Found]] = {case: [] for case in cases}
    for _ in range(repeat):
        for (name, method, full), command in cases.items():
            options = (["--tree"] if method == TREE else []) + (["--full"] if full else [])
            runs[name, method, full].append(case("locate", *command, *options))
    return {name: together(found) for name, found in runs.items()}


def together(runs: list[Found]) -> Found:
    """One result of several: what each frame took at least."""
    least = {name: np.min([run[name] for run in runs], 0) for name in ("map_ms", "align_ms", "processor_ms")}
    total = least["map_ms"] + least["align_ms"]
    return {
        **runs[0], "reading_s": float(least["map_ms"][0]) / 1e3,
        "all_mean": float(total.mean()), "all_median": float(np.median(total)),
        "all_p95": float(np.percentile(total, 95)), "read_mean": float(total[1:].mean()),
        "read_median": float(np.median(total[1:])), "read_p95": float(np.percentile(total[1:], 95)),
        "worst": float(total[1:].max()), "align_mean": float(least["align_ms"][1:].mean()),
        "processor_mean": float(least["processor_ms"][1:].mean()),
        "peak_rss_mb": min(run["peak_rss_mb"] for run in runs),
    }  # fmt: skip


def case(*command: Any) -> Found:
    """Runs a case and gives what it prints."""
    words = [sys.executable, str(HERE / "submap_runs.py"), *map(str, command)]
    output = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True).stdout
    return json.loads(output.splitlines()[-1])


def table(runs: dict[Case, Found]) -> None:
    """Prints what was measured."""
    print(
        "                                      reading  everything, ms a frame     once read, ms a frame\n"
        "                              points        s   mean  median   95 %    mean  median   95 %  worst aligning "
        "processor  RMSE mm located peak MB"
    )
    for (name, method, full), f in runs.items():
        times = [f[key] for key in ("all_mean", "all_median", "all_p95", "read_mean", "read_median", "read_p95")]
        rest = [f[key] for key in ("worst", "align_mean", "processor_mean")]
        print(
            f"{name:>10} {method:8} {'full' if full else 'partial':7} {f['map_points_mean']:9.0f} {f['reading_s']:8.2f}"
            + "".join(f"{value:7.1f}" for value in times + rest)
            + f"{1e3 * f['rmse_m']:9.3f}{100 * f['located_share']:6.1f} %{f['peak_rss_mb']:8.0f}"
        )


def compare(name: str, partial: Found, full: Found) -> None:
    """Prints the ratios of a partial map to the full one."""

    def less(key: str) -> str:
        return f"{100 * (1 - partial[key] / full[key]):.1f} %"

    print(
        f"{name}, partial against full: {less('map_points_mean')} fewer points; {less('reading_s')} less time for "
        f"reading; a frame with everything {less('all_mean')} less time, once read {less('read_mean')} less (median "
        f"{less('read_median')}, 95 % {less('read_p95')}, aligning alone {less('align_mean')}, processor "
        f"{less('processor_mean')}); RMSE x {partial['rmse_m'] / full['rmse_m']:.3f} "
        f"({1e3 * (partial['rmse_m'] - full['rmse_m']):+.3f} mm); peak memory {less('peak_rss_mb')} less"
    )


def growth(name: str, small: Found, large: Found) -> None:
    """Prints how a map ten times as large compares."""

    def times(key: str) -> str:
        return f"x {large[key] / small[key]:.2f}"

    print(
        f"10x against 1x, {name}: reading {times('reading_s')}, a frame with everything {times('all_mean')}, once read "
        f"{times('read_mean')} (median {times('read_median')}, aligning alone {times('align_mean')}, processor "
        f"{times('processor_mean')}), peak memory {times('peak_rss_mb')}"
    )


def available_bytes() -> float:
    """Memory that is free, or unlimited where the system does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return float("inf")
    return next(1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))


if __name__ == "__main__":
    main()
