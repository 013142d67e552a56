# SPDX-License-Identifier: Apache-2.0
"""Work on the cells of a grid store, one task for each, in workers: training, coding, fusing, meshing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol, TypeVar

from ggslam.errors import FormatError, GgslamError
from ggslam.jobs.progress import Observer
from ggslam.jobs.tasks.engines import Engine
from ggslam.jobs.tasks.outcomes import Failure
from ggslam.submaps.cell_keys import CellKey


class CellTask(Protocol):
    """All that a worker needs to know of a cell."""

    @property
    def key(self) -> CellKey:
        """Of the cell."""


Task = TypeVar("Task", bound=CellTask)
Result = TypeVar("Result")


def over_cells(
    stage: str, keys: Sequence[CellKey], task_of: Callable[[CellKey], Task], work: Callable[[Task], Result],
    take: Callable[[CellKey, Result], None], engine: Engine, observer: Observer, done_before: int = 0,
) -> dict[CellKey, Failure]:  # fmt: skip
    """Does a piece of work on each cell. A cell that fails does not keep the others from being done.

    Args:
        stage: name of the work, for the observer.
        keys: the cells, in the order in which they are begun.
        task_of: makes the task of a cell; called in this process when a worker is free.
        work: does a task; a function of a module, so that workers find it.
        take: receives what came of a cell; called in this process, in the order in which cells end.
        engine: where the work is done.
        observer: receives progress updates.
        done_before: cells that an earlier call did, counted in the progress.

    Returns:
        Why cells failed, sorted by cell.

    Raises:
        GgslamError: there is no worker, or what `take` raises.
    """
    failures: dict[CellKey, Failure] = {}
    ended, total = done_before, done_before + len(keys)
    observer.begin(stage, total)

    def end(key: CellKey, found: Result | Failure) -> None:
        nonlocal ended
        if isinstance(found, Failure):
            failures[key] = found
        else:
            take(key, found)
        ended += 1
        observer.advance(ended, total)

    def tasks() -> Iterator[Task]:
        for key in keys:
            try:
                task = task_of(key)
            except FormatError as error:
                end(key, Failure(str(error), error.exit_code))
                continue
            yield task

    engine.do(work, tasks(), lambda task, found: end(task.key, found))
    return dict(sorted(failures.items()))


def raise_own_fault(failures: Mapping[CellKey, Failure], what: str) -> None:
    """Raises GgslamError if a cell failed through a fault of ggslam or of the machine: the next call may do it.

    Args:
        failures: what `over_cells` returned.
        what: what the cells could not be, after the name of the store, such as "map.grid: {} could not be trained".
    """
    own = [failure for failure in failures.values() if failure.exit_code == 1]
    if own:
        raise error_of(own[0], f"{what.format(f'{len(own)} cell' + 's' * (len(own) != 1))}: {own[0].line}")


def error_of(failure: Failure, text: str) -> GgslamError:
    """An error with the exit code of a failure."""
    error = GgslamError(text)
    error.exit_code = failure.exit_code
    return error
