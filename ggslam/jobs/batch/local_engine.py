# SPDX-License-Identifier: Apache-2.0
"""Runs side by side on this machine, each in a process with processors of its own."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ggslam.errors import ConfigError, RunFolderError
from ggslam.jobs.batch.job_states import JobState, State
from ggslam.system.atomic import make_folder
from ggslam.system.foreign import printable

PROCESSORS = 2
"""Of a run, unless the number of workers is asked for: more hardly make it faster."""
_WAIT_S = 0.1
_LINE = 300


@dataclass
class _Worker:
    """A process that makes a run."""

    state: JobState
    process: subprocess.Popen[bytes]
    processors: tuple[int, ...]
    start: float


def shares(workers: int | None) -> list[tuple[int, ...]]:
    """Numbers of the processors of each worker; without a number of workers, two for each.

    Raises:
        ConfigError: no worker.
    """
    there = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
    count = max(1, len(there) // PROCESSORS) if workers is None else workers
    if count < 1:
        raise ConfigError(f"`workers`: expected at least 1, found {workers}")
    each = max(1, len(there) // count)
    return [tuple(there[(k * each + i) % len(there)] for i in range(each)) for k in range(count)]


def run_locally(
    states: Sequence[JobState], workers: int | None = None, changed: Callable[[], None] = lambda: None
) -> None:
    """Makes the runs that wait. `changed` is called now and then. If it is interrupted, so are the runs: what they had
    done they save, and another call goes on with them.

    Raises:
        ConfigError: no worker.
        RunFolderError: a log cannot be written.
    """
    free, busy = shares(workers), list[_Worker]()
    waiting = [state for state in states if state.state is State.WAITING]
    try:
        while waiting or busy:
            while waiting and free:
                busy.append(_start(waiting.pop(0), free.pop(0)))
            for worker in [worker for worker in busy if worker.process.poll() is not None]:
                busy.remove(worker)
                free.append(worker.processors)
                _end(worker)
            changed()
            time.sleep(_WAIT_S)
    finally:
        for worker in busy:
            worker.process.send_signal(signal.SIGTERM)
        for worker in busy:
            with contextlib.suppress(subprocess.TimeoutExpired):
                worker.process.wait(timeout=60)
            worker.process.kill()
    changed()


def _start(state: JobState, processors: tuple[int, ...]) -> _Worker:
    arguments = [*state.arguments()]
    state.begin()
    make_folder(state.run.parent)
    environment = os.environ | {"OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": str(len(processors))}
    try:
        with state.log.open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "ggslam", *arguments], stdin=subprocess.DEVNULL, stdout=log,
                stderr=subprocess.STDOUT, env=environment, start_new_session=True,
            )  # fmt: skip
    except OSError as error:
        raise RunFolderError(f"{state.log}: {error.strerror}") from None
    if hasattr(os, "sched_setaffinity"):
        with contextlib.suppress(OSError):  # it has ended, or may not be told
            os.sched_setaffinity(process.pid, processors)
    return _Worker(state, process, processors, time.monotonic())


def _end(worker: _Worker) -> None:
    code = worker.process.returncode
    worker.state.end(code if code >= 0 else 128 - code, time.monotonic() - worker.start, _last_line(worker.state))


def _last_line(state: JobState) -> str:
    """The error that a run printed, or else the last thing it said."""
    lines = [line.strip() for line in state.log.read_text(encoding="utf-8", errors="replace").splitlines()]
    errors = [line.removeprefix("error:").strip() for line in lines if line.startswith("error:")]
    said = errors or [line for line in lines if line]
    return printable(said[-1][:_LINE]) if said else ""
