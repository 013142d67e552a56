# SPDX-License-Identifier: Apache-2.0
"""The table of the paper on localisation in partial maps (SRT-PM), with ours beside it.

    python scripts/papers/srt_pm.py [--quick]

A laser scanner is carried through generated worlds, each of another seed, and located from its first pose in the map's
cells within R' of it, and in the whole map: points of the map, milliseconds a scan, reading the map included, and RMSE,
as means and standard deviations over the worlds. The paper's recordings are not to be had; these worlds stand in.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import find_benchmarks  # noqa: F401  # isort: skip
from rows import Paper, options

from bench_submaps import case  # isort: skip

RADIUS = 10.0
"""R', metres."""


def spread(values: list[float], digits: int, factor: float = 1.0) -> str:
    """Mean and standard deviation, in words."""
    scaled = factor * np.array(values)
    return f"{scaled.mean():.{digits}f} ± {scaled.std():.{digits}f}"


def per_scan_ms(found: dict[str, Any]) -> float:
    """Mean milliseconds a scan, reading included."""
    return float(np.mean(np.add(found["map_ms"], found["align_ms"])))


def main() -> None:
    arguments = options(__doc__).parse_args()
    size, scans, seeds = (40.0, 12, 1) if arguments.quick else (100.0, 100, 5)
    conditions = f"{seeds} generated worlds of {size:g} x {size:g} m, {scans} scans each, R' {RADIUS:g} m."
    paper = Paper("srt_pm", "Localisation in partial maps (SRT-PM)", conditions)
    found: dict[bool, list[dict[str, Any]]] = {True: [], False: []}
    with tempfile.TemporaryDirectory() as made:
        for seed in range(seeds):
            folder = Path(made, str(seed))
            case("world", folder, "--size", size, "--scans", scans, "--seed", seed)
            for full in (False, True):
                words = ["--radius", RADIUS, *(["--full"] if full else [])]
                found[full].append(case("locate", folder / "map.grid", folder, *words))
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
    paper.write(arguments.out)


if __name__ == "__main__":
    main()
