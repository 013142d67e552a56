# SPDX-License-Identifier: Apache-2.0
"""Runs side by side on this machine, each in a process with processors of its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from ggslam.jobs.batch.job_process import JobProcess
from ggslam.jobs.batch.job_states import JobState, State
from ggslam.jobs.tasks.processors import shares
from ggslam.system.tuning import Tuning


class LocalEngineTuning(Tuning):
    """How local runs are waited for."""

    wait_s = 0.1
    """Seconds between two looks at the running processes."""


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
                busy.append(JobProcess.begin(waiting.pop(0), free.pop(0), with_parent=True))
            for worker in [worker for worker in busy if worker.process.poll() is not None]:
                busy.remove(worker)
                free.append(worker.processors)
                worker.end()
            changed()
            time.sleep(LocalEngineTuning.wait_s)
    finally:
        for worker in busy:
            worker.ask_to_stop()  # all together: saving takes a while
        for worker in busy:
            worker.wait_for_end()
    changed()
