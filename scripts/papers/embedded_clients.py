# SPDX-License-Identifier: Apache-2.0
"""Two clients that send their cells to one server. A part of embedded.py."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from gpu_mapping import run_command
from rows import Paper

from ggslam.jobs.submaps.cell_server import CellServer, listen, send_store
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import GridStore


def add_clients(paper: Paper, recording: Path, frames: int) -> None:
    """Row of two clients that record a half of a recording each, and send their cells to one server at once."""
    halves = {"a": (0, frames // 2, 0), "b": (frames // 2, frames, 1000)}  # b's over T later: the order does not matter
    folder = recording.parent

    def record(visit: str, store: str) -> None:
        start, stop, at = halves[visit]
        words = ["--visit", visit, "--start", start, "--stop", stop, "--at", at]
        run_command("submaps", recording, "--out", folder / store, *words)

    for visit in halves:
        record(visit, f"{visit}.grid")
        record(visit, "both.grid")
    with GridStore.open(folder / "a.grid") as one:
        settings = one.settings
    start = time.perf_counter()
    with (
        GridStore.create(folder / "server.grid", settings) as store,
        CellServer(store, listen("127.0.0.1", 0), "paper") as server,
        ThreadPoolExecutor(len(halves)) as pool,
    ):
        sent = list(pool.map(lambda name: send_store(folder / f"{name}.grid", *server.address, "paper"), halves))
    took = time.perf_counter() - start
    kept, local = content(folder / "server.grid"), content(folder / "both.grid")
    both = content(folder / "a.grid").keys() & content(folder / "b.grid").keys()
    same = kept.keys() == local.keys() and all(kept[key] == local[key] for key in kept.keys() - both)
    paper.add(
        "clients", "two clients at once, a half of the corridor each", "",
        f"{sum(one.bytes for one in sent) / 1e6:.2f} MB in {took:.2f} s, {len(kept)} cells of "
        f"{'+'.join(str(one.written + one.kept) for one in sent)}",
        f"{frames} frames; cells of one client {'equal' if same else 'DIFFER FROM'} those of both visits added here; "
        f"{len(both)} of both clients: the newer one's",
    )  # fmt: skip


def content(path: Path) -> dict[CellKey, object]:
    """All that a store has of its cells: visit, time, parts."""
    with GridStore.open(path) as store:
        cells = {key: store.cell(key) for key in store.cells()}
        return {
            key: (cell.visit, cell.recorded_at, {name: store.get(key, name) for name in cell.parts})
            for key, cell in cells.items()
        }
