# SPDX-License-Identifier: Apache-2.0
"""Runs on the machines of a Ray cluster, a task each. Ray places them, and makes a task again whose worker died.

Where a worker sees the batch's folder (a shared file system), it makes the run there; elsewhere it makes it in a folder
of its own, and the files come back through Ray's object store. Recordings have to be where the manifest says on every
machine, and ggslam has to be installed there in this version.
"""

from __future__ import annotations

import secrets
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ggslam.errors import FormatError, GgslamError
from ggslam.jobs.batch.job_process import make_job
from ggslam.jobs.batch.job_states import JobState, State
from ggslam.jobs.batch.manifest import BatchJob
from ggslam.jobs.tasks.outcomes import Failure
from ggslam.jobs.tasks.processors import own_threads
from ggslam.jobs.tasks.ray_cluster import RayCluster
from ggslam.system.atomic import make_folder, write_text
from ggslam.system.links import remove_folder
from ggslam.system.untrusted_files import read_untrusted, read_untrusted_text

_TOKEN = ".shared-by"
"""File in the batch's folder by which a worker sees that it is the driver's."""


@dataclass(frozen=True)
class Made:
    """Files that a worker produced.

    Attributes:
        exit_code, seconds, line: of the run.
        files: content by path within the batch's folder, where the worker does not share it; else None.
    """

    exit_code: int
    seconds: float
    line: str
    files: dict[str, bytes] | None = None


class Begun:
    """An actor that knows which runs have begun."""

    def __init__(self) -> None:
        self._names: set[str] = set()

    def note(self, name: str) -> None:
        """A worker begins with a run."""
        self._names.add(name)

    def names(self) -> set[str]:
        """Those that have begun."""
        return self._names


@dataclass(frozen=True)
class RayJob:
    """Input of a worker.

    Attributes:
        job: the run to make.
        out: the batch's folder where the driver is.
        token: what its file `.shared-by` holds.
        begun: the actor `Begun`, told that the run has begun.
    """

    job: BatchJob
    out: str
    token: str
    begun: Any


def run_on_ray(
    states: Sequence[JobState], address: str | None = None, changed: Callable[[], None] = lambda: None
) -> None:
    """Makes the runs that wait. `changed` is called now and then. If it is interrupted, the tasks are cancelled; what
    runs in a shared folder had done by their last checkpoint is there for the next call.

    Args:
        states: of all runs.
        address: of the cluster, see `RayCluster`.

    Raises:
        MissingDependency: Ray is not installed.
        GgslamError: there is no cluster at the address.
    """
    waiting = {state.job.name: state for state in states if state.state is State.WAITING}
    token = secrets.token_hex(8)
    with RayCluster(address) as cluster:
        begun = cluster.ray.remote(num_cpus=0)(Begun).remote()

        def look() -> None:
            for name in cluster.ray.get(begun.names.remote()):
                if waiting[name].state is State.WAITING:
                    waiting[name].see_begun()
            changed()

        def take(task: RayJob, made: Made | Failure) -> None:
            _take(waiting[task.job.name], made)

        tasks = [RayJob(state.job, str(state.out.absolute()), token, begun) for state in waiting.values()]
        try:
            for state in list(waiting.values())[:1]:
                write_text(state.out / _TOKEN, token)
            cluster.do(make_on_worker, tasks, take, look)
        finally:
            for state in list(waiting.values())[:1]:
                (state.out / _TOKEN).unlink(missing_ok=True)


def make_on_worker(task: RayJob) -> Made:
    """What a worker does: makes a run in the batch's folder if it sees that, else in one of its own."""
    task.begun.note.remote(task.job.name)
    if _is_shared(Path(task.out), task.token):
        return _make_in_folder(JobState(task.job, Path(task.out)), None)
    with tempfile.TemporaryDirectory(prefix="ggslam-batch-") as folder:
        return _make_in_folder(JobState(task.job, Path(folder)), Path(folder))


def _make_in_folder(state: JobState, root: Path | None) -> Made:
    try:
        make_job(state, own_threads(), with_parent=True)
    except GgslamError as error:
        return Made(1, 0.0, str(error))
    record = state.memory()
    assert record is not None and record.exit_code is not None
    files = None
    if root is not None:
        paths = [path for top in (state.run, state.log) for path in (top.rglob("*") if top.is_dir() else [top])]
        files = {path.relative_to(root).as_posix(): read_untrusted(path) for path in paths if path.is_file()}
    return Made(record.exit_code, record.seconds, record.line, files)


def _is_shared(out: Path, token: str) -> bool:
    try:
        return read_untrusted_text(out / _TOKEN) == token
    except FormatError:
        return False


def _take(state: JobState, made: Made | Failure) -> None:
    """Notes what came back of a run."""
    if isinstance(made, Failure):
        made = Made(made.exit_code, 0.0, made.line)
    if made.files is not None:
        _put(state, made.files)
    state.begin()
    state.end(made.exit_code, made.seconds, made.line)


def _put(state: JobState, files: dict[str, bytes]) -> None:
    """Puts a run that was made elsewhere into the batch's folder: beside its place first."""
    beside = state.run.with_name(f".{state.run.name}-coming")
    remove_folder(beside)
    for name, content in files.items():
        path = state.out / name
        path = beside / path.relative_to(state.run) if path.is_relative_to(state.run) else path
        make_folder(path.parent)
        path.write_bytes(content)
    if beside.is_dir():
        remove_folder(state.run)
        beside.replace(state.run)
