# SPDX-License-Identifier: Apache-2.0
"""A map in cells, refined, meshed, distance-fielded and encoded by one worker, by two and on Ray: what differs.

    python scripts/benchmarks/bench_cells.py --folder /tmp/cells
    python scripts/benchmarks/bench_cells.py --folder /tmp/cells --run runs/house --spacing 3 --steps 200 --engines 1 2

Without `--run` a walk through a generated house is run first (`ggslam synth --scene loop`). The results are compared
file by file; the times are whole commands. Runs in the folder that are there already are used again.
"""

from __future__ import annotations

import argparse
import os
import shutil
from collections import Counter
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from bench_batch import two_workers
from commands import usage

from ggslam.jobs.submaps.stores import INDOORS, store_of_run
from ggslam.submaps.grid import GridStore

ENGINES = ("1", "2", "ray")


def make_run(folder: Path, frames: int) -> Path:
    """A run of a generated house."""
    recording, run = folder / "house", folder / "run"
    if not recording.is_dir():
        size = ["--width", "160", "--height", "120", "--frames", str(frames)]
        usage(["synth", str(recording), "--scene", "loop", *size])
    if not (run / "run.json").is_file():
        usage(["run", str(recording), "--out", str(run), "--no-eval", "--overwrite"])
    return run


def make_store(run: Path, out: Path, spacing: float) -> None:
    """Its map in cells of `spacing` metres."""
    if out.is_dir():
        shutil.rmtree(out)
    with GridStore.create(out, replace(INDOORS, spacing=spacing)) as store:
        store_of_run(run, store)
        keys = store.cells()
    sides = [len({key[axis] for key in keys}) for axis in range(3)]
    print(f"{out}: {len(keys)} cells of {spacing:g} m, {sides[0]} x {sides[1]} x {sides[2]}", flush=True)


def files_of(place: Path) -> dict[str, bytes]:
    """What a command wrote, by name: parts of cells by the cell's key, whatever the number of their writing."""
    if place.is_file():
        return {place.name: place.read_bytes()}
    files = {path.name: path.read_bytes() for path in place.glob("*.ply")}
    with GridStore.open(place) as store:
        for key in store.cells():
            files |= {f"{key}/{part}": store.get(key, part) for part in store.cell(key).parts}
    return files


def do_all(store: Path, folder: Path, engine: str, steps: int) -> dict[str, dict[str, bytes]]:
    """Every cell-wise command by one engine; prints its times and gives what it wrote."""
    place = folder / f"by-{engine}"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    better = place / "better.grid"
    with two_workers() if engine == "ray" else nullcontext() as address:
        more = ["--workers", engine] if address is None else ["--engine", "ray", "--address", address]
        commands = {
            better: ["refine", str(store), "--out", str(better), "--steps", str(steps)],
            place / "volumes": ["volumes", str(better), "--esdf", "--voxel", "0.04", "--out", str(place / "volumes")],
            place / "map.ggc": ["encode", str(better), str(place / "map.ggc")],
        }
        took = {words[0]: usage([*words, *more]) for words in commands.values()}
    seconds = " | ".join(f"{used.seconds:.0f}" for used in took.values())
    print(f"| {engine} | {seconds} | {max(used.peak_mb for used in took.values()):.0f} |", flush=True)
    print("\n".join(f"    {line}" for line in took["refine"].said.splitlines() if "dB" in line), flush=True)
    return {path.name: files_of(path) for path in commands}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="for runs and results; kept")
    parser.add_argument("--run", type=Path, help="whose map is cut in cells")
    parser.add_argument("--frames", type=int, default=480, help="of the generated walk")
    parser.add_argument("--spacing", type=float, default=2.5, help="of cells in metres")
    parser.add_argument("--steps", type=int, default=100, help="of refining, for each cell")
    parser.add_argument("--engines", nargs="+", default=[*ENGINES], choices=ENGINES)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    store = given.folder / "map.grid"
    make_store(given.run or make_run(given.folder, given.frames), store, given.spacing)
    print(f"{os.cpu_count()} processors\n| workers | refine s | volumes s | encode s | MB |\n|---|---|---|---|---|")
    first: dict[str, dict[str, bytes]] | None = None
    for engine in given.engines:
        made = do_all(store, given.folder, engine, given.steps)
        if first is None:
            first, counts = made, Counter({name: len(files) for name, files in made.items()})
            print(f"    files compared: {', '.join(f'{name} {count}' for name, count in counts.items())}")
        differing = [
            f"{name}/{file}" for name in made for file in made[name].keys() | first[name].keys()
            if made[name].get(file) != first[name].get(file)
        ]  # fmt: skip
        print(f"    differing files: {len(differing)}", *differing[:5], flush=True)


if __name__ == "__main__":
    main()
