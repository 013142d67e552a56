# SPDX-License-Identifier: Apache-2.0
"""The table of the paper on localisation in partial maps (SRT-PM), with ours beside it.

    python scripts/papers/srt_pm.py [--quick]

A laser scanner is carried through generated worlds, each of another seed, and located from its first pose in the map's
cells within R' of it, and in the whole map: points of the map, milliseconds a scan, reading the map included, and RMSE,
as means and standard deviations over the worlds. Then: R' that follows what is seen against fixed ones, between rooms
and halls, slow and fast; worlds of equal rooms with things moved since the map was made, maps that drifted; and starts
that are off in such rooms. The paper's recordings are not to be had; these worlds stand in.
"""

from __future__ import annotations

import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import find_benchmarks  # noqa: F401  # isort: skip
from rows import Paper, options

from bench_submaps import case  # isort: skip
from submap_runs import located, looked_up, parse_radius, started  # isort: skip
from ggslam.reporting.plot_files import write_sheet
from ggslam.reporting.plots import Plot, Series
from ggslam.system.atomic import make_folder

RADIUS = 10.0
"""R', metres."""
OFF, TURN = 3.0, 20.0
"""Metres and degrees that starts are off."""
SEES_M = 6.0
"""How far the scanner of the last table sees, metres."""
VOXEL = 0.15
"""Of the target, metres; as `submap_runs.py locate` has it."""
FIXED = (5, 10, 20)
"""R' beside the adaptive one, metres."""
ADAPTIVE: dict[str, tuple[Any, ...]] = {
    "rooms, 1.2 m/s": ("--kind", "rooms", "--every", 1),
    "rooms, 3.6 m/s": ("--kind", "rooms", "--every", 3),
    "rooms and halls, 2.4 m/s": ("--kind", "halls", "--every", 2),
}
CHANGED: dict[str, tuple[Any, ...]] = {
    "equal rooms": ("--kind", "equal"),
    "equal rooms, half of the things moved or gone": ("--kind", "equal", "--changed", 0.5),
    "equal rooms, map 0.5 % too long": ("--kind", "equal", "--stretch", 1.005),
    "halls, map 0.5 % too long": ("--kind", "halls", "--stretch", 1.005),
}
Found = dict[str, Any]


def spread(values: list[float], digits: int, factor: float = 1.0) -> str:
    """Mean and standard deviation, in words."""
    scaled = factor * np.array(values)
    return f"{scaled.mean():.{digits}f} ± {scaled.std():.{digits}f}"


def per_scan_ms(found: Found) -> float:
    """Mean milliseconds a scan, reading included."""
    return float(np.mean(np.add(found["map_ms"], found["align_ms"])))


def make(made: Path, seeds: int, size: float, scans: int, words: tuple[Any, ...] = ()) -> list[Path]:
    """The folders of worlds, one for each seed. They are made side by side: nothing is timed meanwhile."""

    def one(seed: int) -> Path:
        folder = made / f"{seed}"
        case("world", folder, "--size", size, "--scans", scans, "--seed", seed, *words)
        return folder

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(one, range(seeds)))


def locate(folder: Path, radius: float | str) -> Found:
    """Located with R' metres, "auto" or in the whole map, "full"."""
    full = radius == "full"
    reach = RADIUS if full else parse_radius(radius)
    return located(folder / "map.grid", folder, full, False, VOXEL, reach, 0, None, 1.0)


def add_table(paper: Paper, made: Path, size: float, scans: int, seeds: int) -> None:
    """Partial against whole map."""
    found: dict[bool, list[Found]] = {True: [], False: []}
    for folder in make(made, seeds, size, scans):
        for full in (False, True):
            found[full].append(locate(folder, "full" if full else RADIUS))
    for full, name in ((False, "partial map"), (True, "whole map")):
        runs = found[full]
        paper.add("table 1", f"{name}, points", "", spread([run["map_points_mean"] for run in runs], 0))
        paper.add("table 1", f"{name}, time a scan", "", spread([per_scan_ms(run) for run in runs], 1) + " ms",
                  f"of it aligning {spread([float(np.mean(run['align_ms'])) for run in runs], 1)} ms")  # fmt: skip
        paper.add("table 1", f"{name}, RMSE", "", spread([run["rmse_m"] for run in runs], 2, 1e3) + " mm",
                  f"{spread([100 * run['located_share'] for run in runs], 1)} % of the scans located")  # fmt: skip
    pairs = list(zip(found[False], found[True], strict=True))
    points = [100 * (1 - part["map_points_mean"] / whole["map_points_mean"]) for part, whole in pairs]
    times = [100 * (1 - per_scan_ms(part) / per_scan_ms(whole)) for part, whole in pairs]
    paper.add("table 1", "partial against whole, points", "98.8 % fewer", f"{spread(points, 1)} % fewer")
    paper.add("table 1", "partial against whole, time", "34 % less", f"{spread(times, 1)} % less", "reading included")
    errors = [1e3 * (part["rmse_m"] - whole["rmse_m"]) for part, whole in pairs]
    paper.add("table 1", "partial against whole, RMSE", "no loss", f"{spread(errors, 3)} mm more")


def add_runs(paper: Paper, table: str, name: str, runs: dict[float | str, list[Found]]) -> None:
    """A row for each R' that the same worlds were located with."""
    for radius, found in runs.items():
        words = "whole map" if radius == "full" else f"R' {radius}" + (" m" if radius != "auto" else "")
        errors = [run["rmse_m"] for run in found if run["rmse_m"] is not None]
        paper.add(
            table, f"{name}, {words}", "", f"{spread(errors, 2, 1e3)} mm" if errors else "",
            f"largest {max(1e3 * run['error_max_m'] for run in found if run['rmse_m'] is not None):.0f} mm; "
            f"{spread([100 * run['located_share'] for run in found], 1)} % located; "
            f"{spread([run['map_points_mean'] for run in found], 0)} points; "
            f"{spread([per_scan_ms(run) for run in found], 1)} ms a scan",
        )  # fmt: skip


def add_adaptive(paper: Paper, made: Path, out: Path, size: float, scans: int, seeds: int, quick: bool) -> None:
    """R' that follows what is seen against fixed ones; and the figure of points against RMSE."""
    plots = []
    for name, words in list(ADAPTIVE.items())[-1 if quick else 0 :]:
        runs: dict[float | str, list[Found]] = {radius: [] for radius in (*FIXED[: 1 if quick else 3], "auto")}
        for folder in make(made, seeds, size, scans, words):
            for radius, found in runs.items():
                found.append(locate(folder, radius))
        add_runs(paper, "R', RMSE", name, runs)
        series = []
        for color, (radius, found) in enumerate(runs.items()):
            thousands = [run["map_points_mean"] / 1e3 for run in found]
            logs = [np.log10(1e3 * run["rmse_m"]) if run["rmse_m"] else np.nan for run in found]
            series.append(Series(f"R' {radius}", thousands, logs, "dots", color))
        plots.append(Plot(name, name, "thousand points of the map", "log10 of the RMSE in mm", series))
    make_folder(out)
    for file in write_sheet(out / "srt_pm_radius", plots)[:1]:
        paper.show(file, "RMSE over points of the map, a dot for each world")


def add_changed(paper: Paper, made: Path, size: float, scans: int, seeds: int, quick: bool) -> None:
    """Where the whole map serves better than a part, and where worse."""
    for name, words in list(CHANGED.items())[-1 if quick else 0 :]:
        runs: dict[float | str, list[Found]] = {radius: [] for radius in (10, "full")}
        for folder in make(made, seeds, size, scans, ("--every", 2, *words)):
            for radius, found in runs.items():
                found.append(locate(folder, radius))
        add_runs(paper, "changed and equal, RMSE", name, runs)
        more = [1e3 * (part["rmse_m"] - whole["rmse_m"]) for part, whole in zip(runs[10], runs["full"], strict=True)]
        paper.add(
            "changed and equal, RMSE", f"{name}, R' 10 m against whole map", "no loss", f"{spread(more, 3)} mm more",
            f"less in {sum(m < 0 for m in more)} of {len(more)} worlds",
        )  # fmt: skip


def add_starts(paper: Paper, made: Path, size: float, count: int, seeds: int) -> None:
    """Where scans of equal rooms end that start far from their place."""
    radii: tuple[float | str, ...] = (6, 10, "full")
    outcomes: dict[float | str, list[dict[str, int]]] = {radius: [] for radius in radii}
    for folder in make(made, seeds, size, count, ("--kind", "equal", "--every", 20)):
        for radius, found in outcomes.items():
            full = radius == "full"
            reach = RADIUS if full else parse_radius(radius)
            found.append(started(folder / "map.grid", folder, full, reach, OFF, TURN, count)["outcomes"])
    for radius, found in outcomes.items():
        shares = {key: spread([100 * one.get(key, 0) / (4 * count) for one in found], 0)
                  for key in ("right", "wrong", "doubtful", "lost")}  # fmt: skip
        name = "whole map" if radius == "full" else f"R' {radius} m"
        paper.add(
            "starts in equal rooms", f"{OFF:g} m and {TURN:g} degrees off, {name}", "",
            f"{shares['wrong']} % wrong unnoticed",
            f"{shares['right']} % right, {shares['doubtful']} % told to be doubtful, {shares['lost']} % lost",
        )  # fmt: skip


def add_near(paper: Paper, made: Path, size: float, count: int, seeds: int) -> None:
    """Which of equal rooms a scanner that sees 6 m is in: with no position, a rough one, and a wrong one."""
    ways: dict[str, tuple[float | None, float]] = {
        "no position": (None, 0.0), "position within 1 m": (1.0, 0.0), "position 3 m wrong": (0.5, 3.0)
    }
    runs: dict[str, list[Found]] = {name: [] for name in ways}
    for folder in make(made, seeds, size, count, ("--kind", "equal", "--every", 20)):
        for name, where in ways.items():
            runs[name].append(looked_up(folder / "map.grid", folder, *where, SEES_M, count))
    for name, found in runs.items():
        shares = {key: spread([100 * run["outcomes"].get(key, 0) / count for run in found], 0)
                  for key in ("right", "wrong", "lost")}  # fmt: skip
        errors = [run["rmse_m"] for run in found if run["rmse_m"] is not None]
        paper.add("which of equal rooms", name, "", f"{shares['right']} % right",
                  f"{shares['wrong']} % wrong, {shares['lost']} % told to be lost"
                  + (f"; RMSE {spread(errors, 2, 1e3)} mm" if errors else ""))  # fmt: skip


def main() -> None:
    arguments = options(__doc__).parse_args()
    size, scans, seeds = (30.0, 8, 1) if arguments.quick else (100.0, 100, 5)
    conditions = f"{seeds} generated worlds of {size:g} x {size:g} m, {scans} scans each, R' {RADIUS:g} m."
    paper = Paper("srt_pm", "Localisation in partial maps (SRT-PM)", conditions)
    less = (30.0, 8) if arguments.quick else (60.0, 40)
    with tempfile.TemporaryDirectory() as made:
        add_table(paper, Path(made), size, scans, seeds)
        add_adaptive(paper, Path(made), arguments.out, *less, seeds, arguments.quick)
        add_changed(paper, Path(made), *less, seeds, arguments.quick)
        add_starts(paper, Path(made), 30.0 if arguments.quick else 48.0, 1 if arguments.quick else 3, seeds)
        add_near(paper, Path(made), 30.0 if arguments.quick else 48.0, 1 if arguments.quick else 4, seeds)
    paper.write(arguments.out)


if __name__ == "__main__":
    main()
