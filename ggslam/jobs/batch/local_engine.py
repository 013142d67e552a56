# SPDX-License-Identifier: Apache-2.0
"""Runs side by side on this machine, each in a process with processors of its own."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence

from ggslam.errors import ConfigError
from ggslam.jobs.batch.job_process import JobProcess
from ggslam.jobs.batch.job_states import JobState, State

PROCESSORS = 2
"""Of a run, unless the number of workers is asked for: more hardly make it faster."""
_WAIT_S = 0.1


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
    free, busy = shares(workers), list[JobProcess]()
    waiting = [state for state in states if state.state is State.WAITING]
    try:
        while waiting or busy:
            while waiting and free:
                busy.append(JobProcess.begin(waiting.pop(0), free.pop(0)))
            for worker in [worker for worker in busy if worker.process.poll() is not None]:
                busy.remove(worker)
                free.append(worker.processors)
                worker.end()
            changed()
            time.sleep(_WAIT_S)
    finally:
        for worker in busy:
            worker.ask_to_stop()  # all together: saving takes a while
        for worker in busy:
            worker.wait_for_end()
    changed()
