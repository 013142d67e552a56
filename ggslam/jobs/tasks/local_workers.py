# SPDX-License-Identifier: Apache-2.0
"""Pieces of work in processes of this machine, each with processors of its own. One that dies is replaced, and its
piece of work begun again."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any, Generic

from ggslam.jobs.tasks.outcomes import Failure, Result, RetryTuning, Task, outcome_of, worker_died
from ggslam.jobs.tasks.processors import shares


def do_locally(
    work: Callable[[Task], Result], tasks: Iterable[Task], take: Callable[[Task, Result | Failure], None],
    workers: int | None = None,
) -> None:  # fmt: skip
    """Does pieces of work; a single worker is this process.

    Args:
        work: a function of a module, so that workers find it.
        tasks: its arguments; asked for when a worker is free. They, and results, have to be picklable.
        take: is given each piece of work with its result, in the order in which they end.
        workers: so many at once; None: one for every two processors.

    Raises:
        ConfigError: no worker.
    """
    places = shares(workers)
    if len(places) == 1:
        for task in tasks:
            take(task, outcome_of(work, task))
        return
    with _Pool(work, places) as pool:
        pool.run(tasks, take)


class _Worker(Generic[Task]):
    """A worker process and its current task."""

    def __init__(self, processors: Sequence[int]) -> None:
        self.pipe, other = Pipe()
        self.task: tuple[Task, int] | None = None
        """The work that it does, and the worker of it that this is."""
        environment = os.environ | {"OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": str(len(processors))}
        words = [sys.executable, "-m", "ggslam.jobs.tasks.worker", str(other.fileno()), str(os.getpid())]
        with other:
            self.process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                pass_fds=[other.fileno()], env=environment, start_new_session=True,
            )  # fmt: skip
        if hasattr(os, "sched_setaffinity"):
            with contextlib.suppress(OSError):
                os.sched_setaffinity(self.process.pid, processors)

    def give(self, work: Callable[[Task], Any], task: Task, number: int) -> None:
        """Sends work to it, which is lost if it has died."""
        self.task = (task, number)
        with contextlib.suppress(OSError):
            self.pipe.send((work, task))

    def end(self) -> None:
        """Ends it at once: nothing that it does is seen by others before it is done."""
        self.process.kill()
        self.process.wait()
        self.pipe.close()


class _Pool(Generic[Task, Result]):
    """A pool of workers."""

    def __init__(self, work: Callable[[Task], Result], places: Sequence[Sequence[int]]) -> None:
        self._work, self._places = work, places
        self._workers: list[_Worker[Task] | None] = [None] * len(places)

    def __enter__(self) -> _Pool[Task, Result]:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            if worker is not None:
                worker.end()

    def run(self, tasks: Iterable[Task], take: Callable[[Task, Result | Failure], None]) -> None:
        """Gives the work to the workers until all of it is done."""
        waiting = iter(tasks)
        for place in range(len(self._places)):
            self._give_next(place, waiting)
        while busy := {w.pipe: k for k, w in enumerate(self._workers) if w is not None and w.task is not None}:
            for pipe in wait(list(busy)):
                assert isinstance(pipe, Connection)
                self._listen(busy[pipe], waiting, take)

    def _give_next(self, place: int, waiting: Iterable[Task]) -> None:
        for task in waiting:
            self._give(place, task, 1)
            return

    def _give(self, place: int, task: Task, number: int) -> None:
        worker = self._workers[place]
        if worker is None:
            worker = self._workers[place] = _Worker(self._places[place])
        worker.give(self._work, task, number)

    def _listen(
        self, place: int, waiting: Iterable[Task], take: Callable[[Task, Result | Failure], None]
    ) -> None:
        """A worker has something to say, or is dead."""
        worker = self._workers[place]
        assert worker is not None and worker.task is not None
        task, number = worker.task
        try:
            found = worker.pipe.recv()
        except (EOFError, OSError):
            worker.end()
            self._workers[place] = None
            if number < RetryTuning.tries:
                self._give(place, task, number + 1)
                return
            found = worker_died()
        worker.task = None
        take(task, found)
        self._give_next(place, waiting)
