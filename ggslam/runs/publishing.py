# SPDX-License-Identifier: Apache-2.0
"""Putting a run that was written to a hidden folder into its place, all files at once, run.json with the manifest last.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ggslam.errors import GgslamError, RunFolderError
from ggslam.runs.manifest import files_in, without
from ggslam.runs.records.run_json import RunRecord
from ggslam.system.atomic import make_folder, reason_of, sync_folder, write_failure
from ggslam.system.folder_lock import LockTuning, folder_lock
from ggslam.system.links import refuse_links_below
from ggslam.system.staging import make_staging, publish


def publish_run(target: Path, write: Callable[[Path], RunRecord], old: Sequence[str], failure: str) -> None:
    """Writes a run's files to a hidden folder in its folder; when all of them are on the disk they take the place of
    what is there. Whatever ends the program, the folder holds the run from before, or can be opened as the new one.

    Args:
        target: the run's folder; made if it is not there.
        write: writes all files but run.json into a folder, and gives what run.json is to say.
        old: names of files and folders at the target that go unless they are replaced.
        failure: what to say if a file cannot be written, before the reason.

    Raises:
        RunFolderError: a file cannot be written; the target is as it was, or opening it finishes the work.
    """
    make_folder(target)
    with folder_lock(target):
        staged = make_staging(target)
        try:
            mark = write(staged)
            mark = mark.model_copy(update={"files": {**_files_that_stay(staged, target, old), **files_in(staged)}})
            mark.write(staged)
            sync_all(staged)
        except BaseException as error:
            shutil.rmtree(staged, ignore_errors=True)
            if isinstance(error, OSError):
                raise _explain(failure, error) from None
            raise
        meanwhile = {"complete": False, "stopped_by": "saving did not finish"}
        publish(staged, target, RunRecord.FILE, old, mark.model_copy(update=meanwhile).values())
        sync_folder(target)


@contextmanager
def change_files(run: Path, names: Sequence[str]) -> Iterator[None]:
    """Files (or folders of files) of a run are written within the block; the manifest follows. If the program is killed
    within, they are known to be unfinished.

    Raises:
        RunFolderError: another process writes to the run for longer than `LockTuning.wait_s`, there is a link among the
            files, or run.json cannot be written.
    """
    with folder_lock(run, wait_s=LockTuning.wait_s):
        refuse_links_below(run, [RunRecord.FILE, *names])
        mark = RunRecord.read(run)
        if mark.files is None:  # a run of before there were manifests
            yield
            return
        mark.model_copy(update={"files": without(mark.files, names)}).write(run)
        try:
            yield
        finally:
            mark = RunRecord.read(run)
            mark.with_files({**without(mark.files or {}, names), **files_in(run, names)}).write(run)


@contextmanager
def change_in_run(path: Path | None) -> Iterator[None]:
    """A file or folder is written within the block; if it lies in a run's folder, see `change_files`."""
    if path is None or not (path.parent / RunRecord.FILE).is_file():
        yield
        return
    with change_files(path.parent, [path.name]):
        yield


def _files_that_stay(staged: Path, target: Path, old: Sequence[str]) -> dict[str, object]:
    """What the manifest at the target says of files that stay."""
    try:
        files = RunRecord.read(target).files or {}
    except GgslamError:  # no run yet, or a damaged one
        return {}
    stay = without(files, [*old, *(path.name for path in staged.iterdir())])
    return {name: record for name, record in stay.items() if (target / name).is_file()}


def sync_all(folder: Path) -> None:
    """Waits until all files of a folder are on the disk."""
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            descriptor = os.open(path, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        elif path.is_dir():
            sync_folder(path)
    sync_folder(folder)


def _explain(failure: str, error: OSError) -> RunFolderError:
    """As `write_failure`, which knows a full disk from a mistake."""
    found = RunFolderError(f"{failure}: {reason_of(error)}")
    found.exit_code = write_failure("", error).exit_code
    return found
