# SPDX-License-Identifier: Apache-2.0
"""A run of a batch as a process of its own, whoever starts it: this machine, a worker of Ray, a job array."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

from ggslam.errors import RunFolderError
from ggslam.jobs.batch.job_states import JobState
from ggslam.system.atomic import make_folder
from ggslam.system.links import new_file


@dataclass
class JobProcess:
    """A process that makes a run.

    Attributes:
        state: of the run.
        process: that makes it.
        processors: numbers of those it may use.
        start: when it began, seconds of the monotonic clock.
    """

    state: JobState
    process: subprocess.Popen[bytes]
    processors: tuple[int, ...]
    start: float

    @staticmethod
    def begin(state: JobState, processors: Sequence[int], count: int = 0, with_parent: bool = False) -> JobProcess:
        """Begins a run, or goes on with one that was cut off.

        Args:
            state: what to make.
            processors: numbers of those it may use; empty: any.
            count: threads that it computes with; 0: one a processor.
            with_parent: whether it is killed when this process dies, see `tied_process`.

        Raises:
            RunFolderError: its log cannot be written.
        """
        arguments = state.arguments()
        state.begin()
        make_folder(state.run.parent)
        threads = str(count or len(processors))
        tied = ["ggslam.jobs.batch.tied_process", str(os.getpid())] if with_parent else ["ggslam"]
        environment = os.environ | {"OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": threads}
        try:
            with new_file(state.log) as log:
                process = subprocess.Popen(
                    [sys.executable, "-m", *tied, *arguments], stdin=subprocess.DEVNULL, stdout=log,
                    stderr=subprocess.STDOUT, env=environment, start_new_session=True,
                )  # fmt: skip
        except OSError as error:
            raise RunFolderError(f"{state.log}: {error.strerror}") from None
        if processors and hasattr(os, "sched_setaffinity"):
            with contextlib.suppress(OSError):  # it has ended, or may not be told
                os.sched_setaffinity(process.pid, processors)
        return JobProcess(state, process, tuple(processors), time.monotonic())

    def end(self) -> None:
        """Notes what became of a process that has ended."""
        code, line = self.process.returncode, self.state.last_line()
        if code < 0:
            line = f"{_signal_words(-code)}; it said last: {line}" if line else _signal_words(-code)
        self.state.end(code if code >= 0 else 128 - code, time.monotonic() - self.start, line)

    def ask_to_stop(self) -> None:
        """Has a process that may still be at work save what it has done and end. To be called once: a second signal
        ends it at once."""
        if self.process.poll() is None:
            self.process.terminate()

    def wait_for_end(self) -> None:
        """Waits until a process that was asked to stop has saved, but not for ever."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout=60)
        self.process.kill()


def _signal_words(number: int) -> str:
    """What ended a process, for people."""
    try:
        name = signal.Signals(number).name
    except ValueError:
        name = str(number)
    return f"ended by signal {name}" + (", as when memory is full" if number == signal.SIGKILL else "")


def make_job(state: JobState, processors: int, with_parent: bool = False) -> None:
    """Makes a run and waits for it; if this is interrupted, so is the run.

    Args:
        state: what to make.
        processors: threads that it computes with.
        with_parent: see `JobProcess.begin`.

    Raises:
        RunFolderError: its log cannot be written.
    """
    worker = JobProcess.begin(state, (), processors, with_parent)
    try:
        worker.process.wait()
    finally:
        worker.ask_to_stop()
        worker.wait_for_end()
    worker.end()
