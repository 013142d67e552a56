# SPDX-License-Identifier: Apache-2.0
"""Trains a grid store further, cell by cell. `ggslam refine STORE` calls this.

Every cell is trained from the store as it was, with an order of its own, so that the result does not depend on how many
workers there are nor on which cell comes first.
"""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from ggslam import __version__
from ggslam.errors import ConfigError, FormatError, RunFolderError
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.refine.cell_training import TrainedCell, train_cell
from ggslam.jobs.refine.finished_cells import CellsDone, is_cut_off
from ggslam.jobs.refine.settings import RefineSettings
from ggslam.jobs.refine.training_inputs import StoreCells
from ggslam.jobs.stores.over_cells import over_cells, raise_own_fault
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS
from ggslam.jobs.submaps.stores import is_store
from ggslam.jobs.submaps.visit_records import records_of_store
from ggslam.jobs.tasks.engines import Engine
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import GridStore
from ggslam.submaps.store_copy import copy_store
from ggslam.system.plurals import quantity


@dataclass
class StoreRefinement:
    """Result of refining a store.

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
    counts = store.counts(GAUSSIANS)
    if not counts:
        raise ConfigError(f"{store.path}: has no Gaussians to refine; stores made of runs have some")
    records_of_store(store, {store.cell(key).visit for key in counts})


@dataclass
class _Refinement:
    """A store while it is refined."""

    store: GridStore
    done: CellsDone
    settings: RefineSettings
    engine: Engine
    observer: Observer
    trained: list[TrainedCell] = field(default_factory=list)

    def run(self) -> StoreRefinement:
        """Trains what is left to train and puts all of it into the store."""
        start, outcome = time.perf_counter(), StoreRefinement(self.store.path)
        if self.done.is_finished():
            outcome.resumed = outcome.cells = self.done.finish()
            outcome.notes.append("an earlier call had trained all cells; they were put into the store")
            return outcome
        _check_recordings(self.store)
        cells = StoreCells(self.store, self.settings)
        outcome.cells = len(cells.versions)
        if not self.done.begin(_name_of_work(cells)):
            outcome.notes.append("other work on this store that was cut off was thrown away")
        outcome.resumed = sum(key in self.done for key in cells.versions)
        todo = [key for key in sorted(cells.versions) if key not in self.done]
        failures = over_cells(
            "refine", todo, cells.task, train_cell, self._take, self.engine, self.observer, outcome.resumed
        )
        raise_own_fault(failures, f"{self.store.path}: {{}} could not be trained")
        outcome.failures = {key: failure.line for key, failure in failures.items()}
        self._tell(outcome, cells)
        self.done.finish()
        if len(failures) == outcome.cells:
            first = next(iter(outcome.failures.values()))
            raise FormatError(
                f"{self.store.path}: no part of its {quantity(outcome.cells, 'cell')} can be used: {first}"
            )
        outcome.seconds = time.perf_counter() - start
        return outcome

    def _take(self, key: CellKey, found: TrainedCell) -> None:
        self.done.put(key, found.data, found.count)
        self.trained.append(replace(found, data=b""))

    def _tell(self, outcome: StoreRefinement, cells: StoreCells) -> None:
        seen = [cell for cell in self.trained if cell.views]
        outcome.trained, outcome.unseen = len(seen), len(self.trained) - len(seen)
        outcome.steps = self.settings.steps * len(seen)
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
