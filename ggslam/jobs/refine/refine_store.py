# SPDX-License-Identifier: Apache-2.0
"""A grid store trained further, cell by cell: what `ggslam refine STORE` does.

Every cell is trained from the store as it was, with an order of its own, so that the result does not depend on how many
workers there are nor on which cell comes first.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from ggslam import __version__
from ggslam.errors import ConfigError, FormatError, GgslamError, RunFolderError
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.refine.cell_training import CellTask, TrainedCell, train_cell
from ggslam.jobs.refine.cells_done import CellsDone, is_cut_off
from ggslam.jobs.refine.cells_of_store import StoreCells
from ggslam.jobs.refine.settings import RefineSettings
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS
from ggslam.jobs.submaps.stores import is_store
from ggslam.jobs.submaps.visit_records import read_record
from ggslam.jobs.tasks.engines import Engine
from ggslam.jobs.tasks.outcomes import Failure
from ggslam.runs.recordings import open_recorded
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import GridStore
from ggslam.submaps.store_copy import copy_store


@dataclass
class StoreRefinement:
    """What came of refining a store.

    Attributes:
        path: the store.
        cells: with Gaussians.
        trained: by this call.
        resumed: that an earlier call had done.
        unseen: that no keyframe shows enough of; they are as they were.
        failures: cells that could not be trained and why; they are as they were.
        before, after: PSNR of pixels trained on, mean in dB over the keyframes of all cells; NaN if none was trained.
        steps: optimisation steps of this call.
        seconds: of this call.
        notes: what the user should know.
    """

    path: Path
    cells: int = 0
    trained: int = 0
    resumed: int = 0
    unseen: int = 0
    failures: dict[CellKey, str] = field(default_factory=dict)
    before: float = float("nan")
    after: float = float("nan")
    steps: int = 0
    seconds: float = 0.0
    notes: list[str] = field(default_factory=list)


def refine_store(
    path: str | Path, out: str | Path | None = None, *, settings: RefineSettings | None = None,
    engine: Engine | None = None, observer: Observer | None = None,
) -> StoreRefinement:  # fmt: skip
    """Trains the cells of a store further on the keyframes of the runs that filled it.

    The store is as it was until all cells are done. If this is cut off, the same call goes on.

    Args:
        path: of the store.
        out: a new store for the result; None: in place.
        settings: how.
        engine: where; None: on this machine.
        observer: receives progress updates.

    Raises:
        ConfigError: it has no Gaussians, or nothing is known of the recordings that they are from.
        FormatError: the Gaussians of all cells are missing or damaged.
        GgslamError: a recording is not there any more, the store is damaged or cannot be written, or workers died; the
            cells that were done are kept for the next call.
    """
    path, settings = Path(path), settings or RefineSettings()
    target = _target(path, None if out is None else Path(out))
    with GridStore.open(target, write=True) as store:
        done = CellsDone(store, GAUSSIANS)
        try:
            return _Refinement(store, done, settings, engine or Engine(), observer or SilentObserver()).run()
        finally:
            done.close()


def _target(path: Path, out: Path | None) -> Path:
    """The store to work in: a copy is made if that is wanted and was not made before."""
    if out is None or out.resolve() == path.resolve():
        return path
    if is_store(out):
        if not is_cut_off(out):
            raise RunFolderError(f"{out}: is a store already; choose another one with `out`")
        return out
    with GridStore.open(path) as store:
        _check_recordings(store)
    copy_store(path, out)
    return out


def _check_recordings(store: GridStore) -> None:
    """Raises GgslamError if the recordings that the cells are from are not known or not there."""
    visits = {store.cell(key).visit for key in store.cells() if GAUSSIANS in store.cell(key).parts}
    if not visits:
        raise ConfigError(f"{store.path}: has no Gaussians to refine; stores made of runs have some")
    known = {visit: read_record(store, visit) for visit in sorted(v for v in visits if v is not None)}
    if not any(known.values()):
        raise ConfigError(
            f"{store.path}: nothing is known of the recordings that it is from: make it again from its runs"
        )
    for visit, record in known.items():
        if record is not None:
            try:
                open_recorded(record.sequence, record.run)
            except GgslamError as error:
                raise ConfigError(f"{store.path}: the recording of visit {visit!r} is needed: {error}") from None


@dataclass
class _Refinement:
    """A store about to be trained."""

    store: GridStore
    done: CellsDone
    settings: RefineSettings
    engine: Engine
    observer: Observer
    trained: list[TrainedCell] = field(default_factory=list)
    failures: dict[CellKey, Failure] = field(default_factory=dict)
    resumed: int = 0
    total: int = 0

    def run(self) -> StoreRefinement:
        """Trains what is left to train and puts all of it into the store."""
        start, outcome = time.perf_counter(), StoreRefinement(self.store.path)
        if self.done.is_finished():
            outcome.resumed = outcome.cells = self.done.finish()
            outcome.notes.append("an earlier call had trained all cells; they were put into the store")
            return outcome
        _check_recordings(self.store)
        cells = StoreCells(self.store, self.settings)
        outcome.cells = self.total = len(cells.versions)
        if not self.done.begin(_name_of_work(cells)):
            outcome.notes.append("other work on this store that was cut off was thrown away")
        outcome.resumed = self.resumed = sum(key in self.done for key in cells.versions)
        self.observer.begin("refine", outcome.cells)
        self.engine.do(train_cell, self._tasks(cells), self._take)
        ours = [failure for failure in self.failures.values() if failure.exit_code == 1]
        if ours:
            error = GgslamError(f"{self.store.path}: {len(ours)} cells could not be trained: {ours[0].line}")
            error.exit_code = 1
            raise error
        self._tell(outcome, cells)
        self.done.finish()
        if len(self.failures) == self.total:
            first = next(iter(outcome.failures.values()))
            raise FormatError(f"{self.store.path}: no part of its {self.total} cells can be used: {first}")
        outcome.seconds = time.perf_counter() - start
        return outcome

    def _tasks(self, cells: StoreCells) -> Iterator[CellTask]:
        for key in sorted(cells.versions):
            if key in self.done:
                continue
            try:
                task = cells.task(key)
            except FormatError as error:
                self.failures[key] = Failure(str(error), error.exit_code)
                continue
            yield task

    def _take(self, task: CellTask, found: TrainedCell | Failure) -> None:
        if isinstance(found, Failure):
            self.failures[task.key] = found
        else:
            self.done.put(found.key, found.data, found.count)
            self.trained.append(TrainedCell(found.key, b"", found.count, found.views, found.before, found.after))
        self.observer.advance(self.resumed + len(self.trained) + len(self.failures), self.total)

    def _tell(self, outcome: StoreRefinement, cells: StoreCells) -> None:
        seen = [cell for cell in self.trained if cell.views]
        outcome.trained, outcome.unseen = len(seen), len(self.trained) - len(seen)
        outcome.steps = self.settings.steps * len(seen)
        outcome.failures = {key: failure.line for key, failure in sorted(self.failures.items())}
        outcome.notes += [f"not among the Gaussians around its neighbours: {line}" for line in cells.damaged.values()]
        judged = [cell for cell in seen if np.isfinite(cell.before)]
        if judged:
            views = [cell.views for cell in judged]
            outcome.before = float(np.average([cell.before for cell in judged], weights=views))
            outcome.after = float(np.average([cell.after for cell in judged], weights=views))


def _name_of_work(cells: StoreCells) -> str:
    """Made of all that the result depends on."""
    known = [[*key, version] for key, version in sorted(cells.versions.items())]
    text = json.dumps([__version__, asdict(cells.settings), known])
    return hashlib.sha256(text.encode()).hexdigest()
