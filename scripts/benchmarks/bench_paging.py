#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""SLAM with bounded memory: a corridor mapped without a limit of memory and with one, each in its own process.

    python scripts/benchmarks/bench_paging.py --folder /tmp/paging
    python scripts/benchmarks/bench_paging.py --folder /tmp/paging --recording corridor --limit 520
    python scripts/benchmarks/bench_paging.py --folder /tmp/paging --frames 1440 --width 160 --budget 80

Prints for each run: peak resident memory (and against the limit), held-out PSNR, trajectory error, frames per second,
Gaussians in all and the most that were in memory, sizes on disk, and how many times the map's budget the map is. The
reference is the run without a limit in the same invocation.

Without --limit, the limit is what a run of the first frames takes, and --budget beside it.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.timing import TimingRecord

sys.path.insert(0, str(Path(__file__).parents[2]))

from commands import usage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="for recording and runs; kept, to be used again")
    parser.add_argument("--recording", type=Path, help="instead of a corridor generated here")
    parser.add_argument("--frames", type=int, default=360, help="of the generated corridor")
    parser.add_argument("--width", type=int, default=320, help="of its images, 4:3")
    parser.add_argument("--iterations", type=int, default=1, help="mapping iterations per frame")
    parser.add_argument("--limit", type=float, help="resident memory of the limited run, 10^6 bytes")
    parser.add_argument("--budget", type=float, default=40.0, help="without --limit: 10^6 bytes for map and keyframes")
    parser.add_argument("--set", action="append", default=[], dest="overrides", help="a setting of both runs")
    parser.add_argument("--stop", type=int, help="frames of the recording to use")
    parser.add_argument("--together", action="store_true", help="both runs at the same time, on the same processors")
    parser.add_argument("--objects", action="store_true", help="learn objects, too")
    arguments = parser.parse_args()
    recording = arguments.recording or generated(arguments.folder, arguments.frames, arguments.width)
    common = [f"mapping.iterations_per_frame={arguments.iterations}", *arguments.overrides]
    if not arguments.objects:
        common += ["identity.enabled=false", "masks.source=none"]
    limit = arguments.limit
    if limit is None:
        limit = needed(recording, arguments.folder, common) + arguments.budget
        print(f"limit: {limit:.0f} MB, {arguments.budget:g} MB more than a run of 24 frames takes")
    more = [] if arguments.stop is None else ["--stop", str(arguments.stop)]
    with ThreadPoolExecutor(2 if arguments.together else 1) as workers:
        settings = {"unlimited": common, "limited": [*common, f"memory_limit_mb={limit}"]}
        found = workers.map(lambda name: run(recording, arguments.folder / name, settings[name], more), settings)
        report(dict(zip(("no limit", "limited"), found, strict=True)), limit)


def generated(folder: Path, frames: int, width: int) -> Path:
    """The corridor of so many frames, made unless it is there."""
    path = folder / f"corridor{frames}_{width}"
    if not path.is_dir():
        size = ["--width", str(width), "--height", str(width * 3 // 4)]
        command("synth", str(path), "--scene", "corridor", "--frames", str(frames), *size)
    return path


def needed(recording: Path, folder: Path, settings: list[str]) -> float:
    """Resident memory of a short run without its map, MB."""
    found = run(recording, folder / "short", [*settings, "memory_limit_mb=100000"], ["--stop", "24"], scored=False)
    paging = found["timing"].paging
    return float(paging["program_mb"])


def run(recording: Path, out: Path, settings: list[str], more: list[str], scored: bool = True) -> dict[str, Any]:
    """One run in a process of its own, and scoring in another; what they left in the folder."""
    overrides = [word for setting in settings for word in ("--set", setting)]
    peak = command("run", str(recording), "--out", str(out), "--overwrite", "--no-eval", *overrides, *more)
    found: dict[str, Any] = {"timing": TimingRecord.read(out), "peak_mb": peak}
    if scored:
        found["scoring_mb"] = command("eval", str(out), "--no-lpips")
        found["metrics"] = MetricsRecord.read(out)
    found["disk_mb"] = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / 1e6
    return found


def command(*words: str) -> float:
    """Runs `ggslam` with these words and prints what it says of the limit; its largest resident memory, MB."""
    used = usage(words)
    for line in used.said.splitlines():
        if "limit" in line:
            print(f"  {line.strip()}")
    return used.peak_mb


def report(runs: dict[str, dict[str, Any]], limit: float) -> None:
    """Prints the figures of the runs and their ratios."""
    for name, found in runs.items():
        timing, metrics = found["timing"], found["metrics"]
        held_out, trajectory = metrics.images.held_out, metrics.trajectory
        print(
            f"{name}: peak RSS {found['peak_mb']:.0f} MB (scoring {found['scoring_mb']:.0f} MB), "
            f"held-out PSNR {held_out.psnr:.2f} dB, "
            f"ATE {100 * trajectory.ate_rmse_m:.2f} cm, {timing.frames_per_s:.2f} frames/s, "
            f"{timing.gaussians} Gaussians, {timing.mapping.keyframes} keyframes, "
            f"run folder {found['disk_mb']:.0f} MB"
        )
    free, bound = runs.values()
    paging = bound["timing"].paging
    state, room = paging["map_mb"] + paging["images_on_disk_mb"], limit - paging["program_mb"]
    print(f"paging: {json.dumps({key: round(value, 1) for key, value in paging.items()})}")
    print(
        f"limited / no limit: frames/s {ratio('frames_per_s', bound, free):.2f}, Gaussians "
        f"{ratio('gaussians', bound, free):.3f}, peak RSS {bound['peak_mb'] / free['peak_mb']:.2f}; PSNR "
        f"{bound['metrics'].images.held_out.psnr - free['metrics'].images.held_out.psnr:+.2f} dB"
    )
    print(
        f"peak RSS / limit: {bound['peak_mb'] / limit:.3f}, scoring {bound['scoring_mb'] / limit:.3f}; Gaussians / the "
        f"most in memory: {bound['timing'].gaussians / max(1, paging['most_resident']):.1f}"
    )
    if room <= 0:
        print(f"the limit is below the program's own {paging['program_mb']:.0f} MB: choose a larger --budget")
        return
    print(
        f"state (Gaussians with optimizer state {paging['map_mb']:.0f} MB, images and points of keyframes "
        f"{paging['images_on_disk_mb']:.0f} MB) / what the limit leaves beside the program's own "
        f"{paging['program_mb']:.0f} MB: {state / room:.1f}; Gaussians / their part of it: "
        f"{paging['map_mb'] / max(1e-9, paging['gaussian_budget_mb']):.1f}; state / limit: {state / limit:.2f}"
    )


def ratio(name: str, bound: dict[str, Any], free: dict[str, Any]) -> float:
    return float(getattr(bound["timing"], name) / getattr(free["timing"], name))


if __name__ == "__main__":
    main()
