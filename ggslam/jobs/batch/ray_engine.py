# SPDX-License-Identifier: Apache-2.0
"""Runs on the machines of a Ray cluster, a task each. Ray places them, and makes a task again whose worker died.

Where a worker sees the batch's folder (a shared file system), it makes the run there; elsewhere it makes it in a folder
of its own, and the files come back through Ray's object store. Recordings have to be where the manifest says on every
machine, and ggslam has to be installed there in this version.
"""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from ggslam import __version__
from ggslam.errors import GgslamError, MissingDependency
from ggslam.jobs.batch.job_process import make_job
from ggslam.jobs.batch.job_states import JobState, State
from ggslam.jobs.batch.local_engine import PROCESSORS
from ggslam.jobs.batch.manifest import BatchJob
from ggslam.system.atomic import make_folder, write_text

_TRIES = 3
"""Times that a task is made again whose worker died."""
_WAIT_S = 0.2
_TOKEN = ".shared-by"
"""File in the batch's folder by which a worker sees that it is the driver's."""


@dataclass(frozen=True)
class Made:
    """What a worker made.

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


def run_on_ray(
    states: Sequence[JobState], address: str | None = None, changed: Callable[[], None] = lambda: None
) -> None:
    """Makes the runs that wait. `changed` is called now and then. If it is interrupted, the tasks are cancelled; what
    runs in a shared folder had done by their last checkpoint is there for the next call.

    Args:
        states: of all runs.
        address: of the cluster, as `ray.init` takes it ("auto": the one this machine belongs to); None: one on this
            machine, for as long as this takes.

    Raises:
        MissingDependency: Ray is not installed.
        GgslamError: there is no cluster at the address.
    """
    ray = _connect(address)
    waiting = [state for state in states if state.state is State.WAITING]
    token, pending = secrets.token_hex(8), dict[Any, JobState]()
    try:
        begun = ray.remote(num_cpus=0)(Begun).remote()
        make = ray.remote(num_cpus=PROCESSORS, max_retries=_TRIES)(make_on_worker)
        if waiting:
            write_text(waiting[0].out / _TOKEN, token)
        for state in waiting:
            pending[make.remote(state.job, str(state.out.absolute()), token, __version__, begun)] = state
        while pending:
            done, _ = ray.wait(list(pending), timeout=_WAIT_S)
            for reference in done:
                _take(ray, reference, pending.pop(reference))
            names = ray.get(begun.names.remote())
            for state in pending.values():
                if state.job.name in names:
                    state.see_begun()
            changed()
    finally:
        for reference in pending:
            ray.cancel(reference, force=True)
        for state in waiting[:1]:
            (state.out / _TOKEN).unlink(missing_ok=True)
        ray.shutdown()


def make_on_worker(job: BatchJob, out: str, token: str, version: str, begun: Any) -> Made:
    """What a worker does: makes a run in the batch's folder if it sees that, else in one of its own.

    Args:
        job: the run.
        out: the batch's folder where the driver is.
        token: what its file `.shared-by` holds.
        version: of the driver's ggslam.
        begun: the actor `Begun`, told that the run has begun.
    """
    if version != __version__:
        return Made(1, 0.0, f"ggslam {__version__} on the worker, {version} where the batch was begun")
    begun.note.remote(job.name)
    if _is_shared(Path(out), token):
        return _make_in_folder(JobState(job, Path(out)), None)
    with tempfile.TemporaryDirectory(prefix="ggslam-batch-") as folder:
        return _make_in_folder(JobState(job, Path(folder)), Path(folder))


def _make_in_folder(state: JobState, root: Path | None) -> Made:
    try:
        make_job(state, _own_processors(), with_parent=True)
    except GgslamError as error:
        return Made(1, 0.0, str(error))
    record = state.memory()
    assert record is not None and record.exit_code is not None
    files = None
    if root is not None:
        paths = [path for top in (state.run, state.log) for path in (top.rglob("*") if top.is_dir() else [top])]
        files = {path.relative_to(root).as_posix(): path.read_bytes() for path in paths if path.is_file()}
    return Made(record.exit_code, record.seconds, record.line, files)


def _own_processors() -> int:
    """What Ray gave this task."""
    return int(os.environ.get("OMP_NUM_THREADS", PROCESSORS))


def _is_shared(out: Path, token: str) -> bool:
    try:
        return (out / _TOKEN).read_text() == token
    except OSError:
        return False


def _take(ray: ModuleType, reference: Any, state: JobState) -> None:
    """Notes what came back of a run."""
    try:
        made: Made = ray.get(reference)
    except ray.exceptions.RayError as error:
        made = Made(1, 0.0, f"the worker died {_TRIES + 1} times: {_first_line(error)}")
    if made.files is not None:
        _put(state, made.files)
    state.begin()
    state.end(made.exit_code, made.seconds, made.line)


def _put(state: JobState, files: dict[str, bytes]) -> None:
    """Puts a run that was made elsewhere into the batch's folder: beside its place first."""
    beside = state.run.with_name(f".{state.run.name}-coming")
    shutil.rmtree(beside, ignore_errors=True)
    for name, content in files.items():
        path = state.out / name
        path = beside / path.relative_to(state.run) if path.is_relative_to(state.run) else path
        make_folder(path.parent)
        path.write_bytes(content)
    if beside.is_dir():
        shutil.rmtree(state.run, ignore_errors=True)
        beside.replace(state.run)


def _connect(address: str | None) -> ModuleType:
    try:
        import ray
    except ImportError:
        raise MissingDependency("batches on Ray need it: pip install 'ggslam[ray]'") from None
    try:
        ray.init(address=address, include_dashboard=False if address is None else None, log_to_driver=False)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise GgslamError(f"no Ray cluster at {address}: {_first_line(error)}") from None
    return ray


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
