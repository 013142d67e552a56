#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Memory and time of what reads a saved run's map, against the size of the map.

    ggslam synth room --frames 30 --width 200 --height 150
    ggslam run room --out base --no-eval
    python scripts/benchmarks/bench_export_memory.py --base base --folder /tmp/storeys --times 1 4 10

Copies of a run's map are put above each other as the storeys of a building and written cell by cell, as runs with a
limit of memory write theirs. Each command works in a process of its own on the building and, where --whole is given, on
one without `map_cells.json`, of which render and eval read the whole map. Prints peak resident memory and seconds, and
their ratios to the smallest building's, and by how much memory grows per byte that the map's file grows.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np
import torch
from commands import Usage, usage

from ggslam.formats.gaussian_ply import write_gaussian_parts
from ggslam.objects.segmented_map import ObjectVotes
from ggslam.objects.table import ObjectTable
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_index import MAP_INDEX, write_map_index
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.submaps.gaussian_cells import GaussianCells
from ggslam.submaps.grid import GridStore
from ggslam.submaps.settings import SubmapSettings

COPIED = ("run.json", "trajectory.txt", "keyframes.json", "config.yaml", "sequence.json", "loops.json", "timing.json",
          "classifier.npz")  # fmt: skip
GAP_M = 1.0
"""Between storeys."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--base", type=Path, required=True, help="a run with objects")
    parser.add_argument("--folder", type=Path, required=True, help="for buildings and what is made of them; kept")
    parser.add_argument("--storeys", type=int, default=10, help="of the smallest building")
    parser.add_argument("--times", type=int, nargs="+", default=[1, 4, 10], help="sizes, in smallest buildings")
    parser.add_argument("--cell", type=float, default=1.0, help="edge of a cell, metres")
    parser.add_argument("--views", type=int, default=4, help="that are rendered; as many frames are scored")
    parser.add_argument("--slices", type=int, default=10, help="that the smallest building is coded in at least")
    parser.add_argument("--whole", action="store_true", help="render and eval without the index of the cells, too")
    parser.add_argument("--only", nargs="+", help="names of commands")
    arguments = parser.parse_args()
    used: dict[str, dict[int, Usage]] = {}
    sizes: dict[int, float] = {}
    for times in arguments.times:
        run = building(arguments.base, arguments.folder, arguments.storeys * times, arguments.cell)
        sizes[times] = (run / "map.ply").stat().st_size / 1e6
        print(f"{times}x: {json.loads((run / MAP_INDEX).read_text())['gaussians']} Gaussians, {sizes[times]:.0f} MB")
        out = arguments.folder / "out"
        for name, words in commands(run, out, arguments, times).items():
            if arguments.only and name not in arguments.only:
                continue
            found = used.setdefault(name, {})[times] = usage(words)
            print(f"  {name}: {found.peak_mb:.0f} MB, {found.seconds:.1f} s", flush=True)
    report(used, sizes)


def building(base: Path, folder: Path, storeys: int, cell: float) -> Path:
    """A run whose map is that of `base` so many times, made unless it is there."""
    path = folder / f"storeys{storeys}"
    if (path / "run.json").is_file():
        return path
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True)
    source = RunFolder.open(base)
    scene = source.segmented_map()
    height = float(np.ptp(scene.gaussians.means[:, 1].numpy())) + GAP_M
    votes = scene.votes or ObjectVotes(np.zeros((len(scene.gaussians), 4)), np.zeros((len(scene.gaussians), 4)))
    store = GridStore.create(path / "grid", SubmapSettings(spacing=cell))
    cells = GaussianCells(store, scene.gaussians)
    for storey in range(storeys):
        one = source.gaussians()
        one.vote_ids[:] = torch.from_numpy(votes.ids.astype(np.int32))
        one.vote_weights[:] = torch.from_numpy(votes.weights.astype(np.float32))
        one.means[:, 1] += storey * height
        cells.move_out(one, cells.cells_of(one))
    extra = ("object_id", "identity")
    write_gaussian_parts(path / "map.ply", cells.count, (p for _, p in cells.parts()), scene.gaussians, extra)
    write_map_index(path / MAP_INDEX, cells)
    parts = [ObjectVotes.of(part) for _, part in cells.parts()]
    together = ObjectVotes(np.concatenate([p.ids for p in parts]), np.concatenate([p.weights for p in parts]))
    (path / "votes.npz").write_bytes(together.to_bytes())
    names = {record.id: record.name for record in scene.table.objects if record.name}
    table = ObjectTable.of_parts(
        (p for _, p in cells.parts()), scene.classifier, scene.table.supervision, names
    )  # fmt: skip
    table.save(path / "objects.json")
    store.close()
    shutil.rmtree(path / "grid")
    for name in reversed(COPIED):
        shutil.copyfile(base / name, path / name)
    return path


def commands(run: Path, out: Path, arguments: argparse.Namespace, times: int) -> dict[str, list[str]]:
    """What is measured on a building, by name."""
    shutil.rmtree(out, ignore_errors=True)
    views = ["--every", str(max(1, len(KeyframesRecord.read(run).frames) // arguments.views))]
    slices = ["--slices", str(arguments.slices * times)]
    found = {
        "export ply": ["export", run, "--out", out / "map.ply"],
        "export segmented": ["export", run, "--format", "segmented", "--out", out / "segmented.ply"],
        "export objects": ["export", run, "--objects", "all", "--out", out / "objects"],
        "export points": ["export", run, "--format", "points", "--voxel", "0.02", "--out", out / "points"],
        "encode": ["encode", run, out / "map.bin", "--preset", "splat", *slices],
        "decode": ["decode", out / "map.bin", out / "decoded.ply"],
        "render": ["render", run, "--what", "color,ids", "--out", out / "pictures", *views],
        "eval": ["eval", run, "--no-lpips", *views],
    }
    if arguments.whole:
        whole = out / "whole"
        whole.mkdir(parents=True)
        for path in run.iterdir():
            if path.name not in (MAP_INDEX, "metrics.json", "frames.csv", "renders"):
                (whole / path.name).symlink_to(path.resolve())
        found["render, whole map"] = ["render", whole, "--what", "color,ids", "--out", out / "pictures", *views]
        found["eval, whole map"] = ["eval", whole, "--no-lpips", *views]
    return {name: [str(word) for word in words] for name, words in found.items()}


def report(used: dict[str, dict[int, Usage]], sizes: dict[int, float]) -> None:
    """Prints the figures and ratios."""
    first, last = min(sizes), max(sizes)
    for name, by_size in used.items():
        one = by_size[first]
        for times, own in sorted(by_size.items()):
            ratios = f"{own.peak_mb / one.peak_mb:.2f} x and {own.seconds / one.seconds:.2f} x"
            print(f"{name}, {times}x: {own.peak_mb:.0f} MB, {own.seconds:.1f} s ({ratios})")
        if last != first:
            grown = by_size[last].peak_mb - one.peak_mb
            print(f"{name}: memory grows by {grown / (sizes[last] - sizes[first]):.2f} byte per byte of the map")


if __name__ == "__main__":
    main()
