#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What the grid store costs: writing and reading cells, and partial maps against whole ones.

    python scripts/benchmarks/bench_grid_store.py --folder /tmp/worlds
    python scripts/benchmarks/bench_grid_store.py --folder /tmp/worlds --parts worlds --side 100 --points 4000000

Parts:
    cells    a cell of 30,000 points of walls: size, and the time to write it (alone and with others) and to read it
    worlds   ground of SIDE x SIDE metres with buildings' walls, and one of ten times that area: entering a cell, and
             staying in it, against reading all cells into memory

Times are the least of several repetitions, of walks the least median, unless another figure is named.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "submaps"))

import numpy as np
from partial_map import PartialMap

from ggslam.submaps.cell_points import POINTS, decode_points, encode_points
from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.cells_around import MapStatus
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import load_points, store_cloud
from ggslam.submaps.settings import SubmapSettings

SETTINGS = SubmapSettings(axes="xy", voxel=0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True, help="where to write stores; they are removed at the end")
    parser.add_argument("--parts", nargs="+", choices=("cells", "worlds"), default=["cells", "worlds"])
    parser.add_argument("--side", type=float, default=50.0, help="metres of the small world")
    parser.add_argument("--points", type=int, default=1_000_000, help="of the small world")
    arguments = parser.parse_args()
    if "cells" in arguments.parts:
        measure_cells(arguments.folder / "cells.grid")
    if "worlds" in arguments.parts:
        measure_worlds(arguments.folder, arguments.side, arguments.points)


def measure_cells(folder: Path) -> None:
    """Prints what one cell of 30,000 points costs."""
    points = walls(30_000)
    data = encode_points({"points": points})
    print(f"cell of {len(points)} points: {len(data) / 1e3:.0f} KB, {len(data) / points.nbytes:.2f} of its values")
    print(f"  encode {least(lambda: encode_points({'points': points})):.1f} ms, ", end="")
    print(f"decode {least(lambda: decode_points(data, 'cell')):.1f} ms")
    shutil.rmtree(folder, ignore_errors=True)
    with GridStore.create(folder, SETTINGS) as store:
        alone = [milliseconds(partial(store.put, (n, 0, 0), {POINTS: data})) for n in range(30)]
        writes = [CellWrite((n, 1, 0), {POINTS: data}) for n in range(64)]
        together = min(milliseconds(lambda: store.put_cells(writes)) for _ in range(3)) / len(writes)
        plain = least(lambda: (folder / "plain").write_bytes(data))
        print(
            f"  write, waiting for the disk: least {min(alone):.1f} ms, median {np.median(alone):.1f} ms; 64 together "
            f"{together:.1f} ms each; a plain file without waiting {plain:.2f} ms"
        )
        print(f"  read and decode {least(lambda: load_points(store, (3, 0, 0))):.1f} ms")
    shutil.rmtree(folder)


def measure_worlds(folder: Path, side: float, count: int, rounds: int = 5) -> None:
    """Prints the costs of a partial map in a world and in one of ten times its area, measured in turns."""
    paths = {"the world": folder / "small.grid", "10x the world": folder / "large.grid"}
    write_world(paths["the world"], side, side, count)
    write_world(paths["10x the world"], 10 * side, side, 10 * count)
    positions = [np.array([x, side / 2, 1.5]) for x in np.arange(12, min(side, 50.0) - 10, 0.25)]
    times: dict[str, dict[str, float]] = {name: {} for name in paths}
    for _ in range(rounds):
        for name, path in paths.items():
            for what, spent in walk(path, positions).items():
                times[name][what] = min(spent, times[name].get(what, np.inf))
    for name, path in paths.items():
        with GridStore.open(path) as store:
            times[name]["reading all cells"] = whole = milliseconds(lambda: read_all(store))
        print(f"{name}:")
        for what, spent in times[name].items():
            print(f"  {what}: {spent:.2f} ms, 1 / {whole / spent:.0f} of reading all cells")
    for what, spent in times["10x the world"].items():
        print(f"10x the world takes {spent / times['the world'][what]:.2f} of the time: {what}")
    for path in paths.values():
        shutil.rmtree(path)


def write_world(folder: Path, length: float, width: float, count: int) -> None:
    """Writes a store, and prints its size."""
    shutil.rmtree(folder, ignore_errors=True)
    with GridStore.create(folder, SETTINGS) as store:
        points = ground(length, width, count)
        began = time.perf_counter()
        keys = store_cloud(store, points)
        took = time.perf_counter() - began
        size = sum(store.cell(key).bytes for key in keys)
        with PartialMap(store) as part:
            part.update(np.array([length / 2, width / 2, 1.5]))
            share = len(part.points) / count
    print(
        f"{length:g} x {width:g} m, {count} points: {len(keys)} cells, {size / 1e6:.0f} MB, cut and written in "
        f"{took:.1f} s; a partial map in its middle has {100 * (1 - share):.1f} % fewer points"
    )


def walk(folder: Path, positions: list[np.ndarray]) -> dict[str, float]:
    """Median milliseconds by what an update had to do; a first walk has filled the system's file cache."""
    times = {"opening": milliseconds(lambda: GridStore.open(folder).close())}
    with GridStore.open(folder) as store:
        for name, lookahead in (("entering a cell", 0.0), ("entering a cell, loaded ahead", 4.0)):
            settings = SubmapSettings(axes="xy", lookahead=lookahead, cache_megabytes=100)
            spent: dict[MapStatus, list[float]] = {status: [] for status in MapStatus}
            with PartialMap(store, settings) as part:
                part.update(positions[0])
                for position in positions[1:]:
                    began = time.perf_counter()
                    status = part.update(position)
                    spent[status].append(1e3 * (time.perf_counter() - began))
                    part.wait()
            times[name] = float(np.median(spent[MapStatus.CHANGED]))
            times["staying in a cell"] = float(np.median(spent[MapStatus.UNCHANGED]))
    return times


def read_all(store: GridStore) -> np.ndarray:
    """Every point of a store in memory."""
    return np.concatenate([load_points(store, key)["points"] for key in store.cells()])


def walls(count: int) -> np.ndarray:
    """Three walls of a corner in one cell, with 3 mm of noise, float32 [N, 3]."""
    generator = np.random.default_rng(0)
    points = generator.random((count, 3)) * 2
    points[np.arange(count), np.arange(count) % 3] = 0
    return (points + [37, -13, 0] + generator.normal(0, 0.003, points.shape)).astype(np.float32)


def ground(length: float, width: float, count: int) -> np.ndarray:
    """Ground and, on half of the points, walls 3 m high along lines 10 m apart, float32 [N, 3]."""
    generator = np.random.default_rng(0)
    points = generator.random((count, 3)) * [length, width, 3]
    points[: count // 2, 2] = 0
    points[count // 2 :, 1] = np.round(points[count // 2 :, 1] / 10) * 10
    return (points + generator.normal(0, 0.005, points.shape)).astype(np.float32)


def milliseconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - began)


def least(work: Callable[[], object], repetitions: int = 15) -> float:
    return min(milliseconds(work) for _ in range(repetitions))


if __name__ == "__main__":
    main()
