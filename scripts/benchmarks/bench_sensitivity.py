# SPDX-License-Identifier: Apache-2.0
"""What each number is worth: halves and doubles it and prints how ATE, PSNR and mIoU of short runs change.

    python scripts/benchmarks/bench_sensitivity.py room livingroom@0.25 --csv numbers.csv --names tracking. loops.
    python scripts/benchmarks/bench_sensitivity.py room livingroom@0.25 --csv numbers.csv --tuning mapping tracking
    python scripts/benchmarks/bench_sensitivity.py room --csv numbers.csv --print

Each run appends a row, so that a table that was cut off goes on where it ended. A row whose hash (of trajectory and
map) is the unchanged run's shows a number that these recordings do not use: it is idle, or it guards against what they
lack. Nothing is halved or doubled out of its range; bools are turned, choices are left alone. --screen looks for idle
numbers only: it does not score, and a number that made a difference once is not run again.
"""

from __future__ import annotations

import argparse
import csv
import gc
import hashlib
import importlib
import pkgutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import GgslamError
from ggslam.jobs.eval.run import score_run
from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs.recordings import SequenceRequest
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.slam.config import Config
from ggslam.system.interrupts import StopRequest, stop_on_request
from ggslam.system.settings import walk
from ggslam.system.tuning import Tuning, overridden

SCORES = ("ate_mm", "psnr_db", "miou")
COLUMNS = ("recording", "number", "value", "hash", *SCORES, "seconds", "error")
BASE = "(unchanged)"


@dataclass(frozen=True)
class Change:
    """A number with another value: as an override of the settings, or as a field `Class:name` of a tuning class."""

    name: str
    value: Any

    @property
    def overrides(self) -> list[str]:
        """For `load_config`."""
        return [] if self.name == BASE or ":" in self.name else [f"{self.name}={str(self.value).lower()}"]


def other_values(value: Any, low: float | None = None, high: float | None = None) -> list[Any]:
    """Half and twice a number within its range, next integers of small ones, the other value of a bool."""
    if isinstance(value, bool):
        return [not value]
    if not isinstance(value, (int, float)):
        return []
    twice = 2 * value or 1
    found = [value // 2, twice] if isinstance(value, int) else [value / 2, twice]
    low, high = (-np.inf if low is None else low), (np.inf if high is None else high)
    bounded = [type(value)(min(max(one, low), high)) for one in found]
    return [one for one in dict.fromkeys(bounded) if one != value]


def setting_changes(prefixes: list[str], internal: bool) -> Iterator[Change]:
    """Of every setting, or internal one, whose path begins with one of the prefixes."""
    for one in walk(Config):
        if one.path.startswith(tuple(prefixes)) and (one.internal or not internal):
            low, high = one.declaration.low, one.declaration.high
            yield from (Change(one.path, value) for value in other_values(one.default, low, high))


def tuning_changes(rooms: list[str]) -> Iterator[Change]:
    """Of every number in the tuning classes of these rooms."""
    for room in rooms:
        for name, kind in sorted(tuning_classes(room).items()):
            for field, value in vars(kind).items():
                if not field.startswith("_"):
                    yield from (Change(f"{name}:{field}", other) for other in other_values(value))


@cache
def tuning_classes(room: str) -> dict[str, type[Tuning]]:
    """Tuning classes of a room as "room.Class"."""
    package = importlib.import_module(f"ggslam.{room}")
    for found in pkgutil.walk_packages(package.__path__, f"ggslam.{room}."):
        with suppress(ImportError, GgslamError):  # needs a package that is not here
            importlib.import_module(found.name)
    kinds = [kind for kind in Tuning.__subclasses__() if kind.__module__.startswith(f"ggslam.{room}.")]
    return {f"{room}.{kind.__name__}": kind for kind in kinds}


@contextmanager
def applied(change: Change) -> Iterator[None]:
    """Fields of tuning classes hold another value meanwhile."""
    if ":" not in change.name:
        yield
        return
    name, field = change.name.split(":")
    with overridden(tuning_classes(name.split(".")[0])[name], **{field: change.value}):
        yield


def run(
    sequence: SequenceRequest, change: Change, least: list[str], base: dict[str, Any] | None, scored: bool
) -> dict[str, Any]:
    """One run in this process; a row of the table. What equals the unchanged run `base` has its scores."""
    start = time.perf_counter()
    row: dict[str, Any] = {"recording": sequence.path.name, "number": change.name, "value": change.value}
    try:
        with tempfile.TemporaryDirectory() as temporary, applied(change):
            overrides, out = [*least, *change.overrides], Path(temporary) / "run"
            outcome = execute(
                RunRequest(sequence, out, None, overrides, evaluate=False, check=False, checkpoint_every=0)
            )
            if outcome.error is not None:
                raise outcome.error
            row["hash"] = hash_of(out)
            if base is not None and base["hash"] == row["hash"]:
                row |= {name: base[name] for name in SCORES}
            elif scored:
                row |= scores(score_run(outcome.folder, sequence.open(), SilentObserver(), lpips=False))
    except (GgslamError, ArithmeticError, ValueError, IndexError, RuntimeError) as error:
        row["error"] = f"{type(error).__name__}: {error}"[:120]
    gc.collect()
    return {**row, "seconds": round(time.perf_counter() - start, 1)}


def scores(metrics: MetricsRecord) -> dict[str, float | None]:
    """ATE, PSNR of held-out views and mIoU of a run."""
    ate, views, objects = metrics.trajectory, metrics.images.held_out, metrics.segmentation
    return {
        "ate_mm": None if ate is None or ate.ate_rmse_m is None else 1e3 * ate.ate_rmse_m,
        "psnr_db": None if views is None else views.psnr,
        "miou": None if objects is None or objects.all is None else objects.all.miou,
    }


def hash_of(folder: Path) -> str:
    """Of trajectory and map."""
    text = (folder / "map.ply").read_bytes()
    return hashlib.sha256((folder / "trajectory.txt").read_bytes() + text[text.find(b"end_header") :]).hexdigest()[:12]


class Table:
    """Rows in a CSV file."""

    def __init__(self, path: Path) -> None:
        self.path, self.rows = path, list[dict[str, str]]()
        if path.exists():
            with path.open(newline="") as stream:
                self.rows = list(csv.DictReader(stream))

    def row(self, recording: str, name: str, value: Any) -> dict[str, str] | None:
        """A run that was made before."""
        key = (recording, name, str(value))
        return next((r for r in self.rows if (r["recording"], r["number"], r["value"]) == key), None)

    def add(self, row: dict[str, Any]) -> dict[str, str]:
        """Appends a row to the file; returns it as it is read again."""
        begin = not self.path.exists()
        with self.path.open("a", newline="") as stream:
            writer = csv.DictWriter(stream, COLUMNS)
            if begin:
                writer.writeheader()
            writer.writerow(row)
        self.rows.append({name: "" if row.get(name) is None else str(row[name]) for name in COLUMNS})
        return self.rows[-1]

    def is_idle(self, recording: str, name: str) -> bool:
        """Whether no value of a number changed a recording's run."""
        base = self.row(recording, BASE, "")
        mine = [row for row in self.rows if (row["recording"], row["number"]) == (recording, name)]
        return base is not None and bool(mine) and all(row["hash"] in ("", base["hash"]) for row in mine)


def print_table(table: Table) -> None:
    """Changes of the scores, the largest change of PSNR first; and what nothing changed."""
    names = list(dict.fromkeys(row["number"] for row in table.rows if row["number"] != BASE))
    recordings = list(dict.fromkeys(row["recording"] for row in table.rows))
    print(f"{'number':52} {'value':>10} {'recording':>14} {'ATE mm':>8} {'PSNR dB':>8} {'mIoU':>7}")
    for row in sorted(table.rows, key=lambda row: -abs(_difference(table, row, "psnr_db"))):
        base = table.row(row["recording"], BASE, "")
        if base is None or row["number"] == BASE or row["hash"] == base["hash"]:
            continue
        changes = [_difference(table, row, name) for name in SCORES]
        said = row["error"] or "{:+8.2f} {:+8.2f} {:+7.3f}".format(*changes)
        print(f"{row['number']:52} {row['value']:>10.10} {row['recording']:>14} {said}")
    idle = [name for name in names if all(table.is_idle(recording, name) for recording in recordings)]
    print(f"\n{len(idle)} of {len(names)} numbers change none of {', '.join(recordings)}:", *idle, sep="\n    ")


def _difference(table: Table, row: dict[str, Any], name: str) -> float:
    base = table.row(row["recording"], BASE, "")
    return float(row[name]) - float(base[name]) if base and row[name] and base[name] else 0.0


def measure(arguments: argparse.Namespace, table: Table, stop: StopRequest, say: Callable[[str], None]) -> None:
    """Makes the runs that the table lacks."""
    changes = [*setting_changes(arguments.names, arguments.internal), *tuning_changes(arguments.tuning)]
    used: set[str] = set()
    for recording in arguments.recordings:
        path, _, scale = recording.partition("@")
        sequence = SequenceRequest(Path(path), stop=arguments.stop, stride=arguments.stride, scale=float(scale or 1))
        own = sequence.path.name
        for change in [Change(BASE, ""), *changes]:
            if arguments.screen and change.name in used:
                continue
            base, row = table.row(own, BASE, ""), table.row(own, change.name, change.value)
            if row is None:
                row = table.add(run(sequence, change, arguments.set, base, base is None or not arguments.screen))
                stop.raise_if_any()
                say(" ".join(row.values()))
            if base is not None and row["hash"] not in ("", base["hash"]):
                used.add(change.name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", metavar="RECORDING[@SCALE]", help="scale: of the images")
    parser.add_argument("--csv", type=Path, required=True, help="rows are appended to this file")
    parser.add_argument("--names", nargs="*", default=[], metavar="PREFIX", help="settings by the begin of their paths")
    parser.add_argument("--internal", action="store_true", help="only internal settings")
    parser.add_argument("--tuning", nargs="*", default=[], metavar="ROOM", help="tuning classes of these rooms")
    parser.add_argument("--stop", type=int, default=16, help="frames of each recording")
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--set", nargs="*", default=["mapping.iterations_per_frame=1", "refine_iterations=10"])
    parser.add_argument("--screen", action="store_true", help="leave out what changed an earlier recording")
    parser.add_argument("--print", action="store_true", help="only print the table")
    arguments = parser.parse_args()
    table = Table(arguments.csv)
    if not arguments.print:
        with stop_on_request() as stop:
            measure(arguments, table, stop, lambda line: print(line, flush=True))
    print_table(table)


if __name__ == "__main__":
    main()
