# SPDX-License-Identifier: Apache-2.0
"""One writer at a time in a folder, or of one output: a file that is locked while it writes, and that says who it is.

The system lets go of the lock when the process ends, however it ends: nothing is left that somebody has to remove.
"""

from __future__ import annotations

import errno
import logging
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ggslam.errors import RunFolderError
from ggslam.system.links import refuse_shared_file
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import printable

try:
    import fcntl
except ImportError:  # no such locks on this system
    fcntl = None  # type: ignore[assignment]

LOCK_FILE = ".lock"
_UNABLE = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL)
"""File systems that have no locks."""


class LockTuning(Tuning):
    """How long a process waits for a folder that another one writes."""

    quiet_s = 2.0
    """Seconds before it says that it waits."""
    wait_s = 600.0
    """Seconds that a command waits which writes beside others."""


_log = logging.getLogger(__name__)


_Key = tuple[int, int, str]
_held: dict[_Key, list[int]] = {}
"""What this process has locked (device and inode of the folder, name of the file): how many times over, and by which
descriptor."""
_guard = threading.Lock()


class FolderInUse(RunFolderError):
    """Another process writes to a folder."""


@contextmanager
def folder_lock(folder: Path, wait_s: float = 0.0) -> Iterator[None]:
    """This process alone writes to a folder within the block. Blocks may be nested.

    Args:
        folder: which must exist.
        wait_s: seconds to wait for another process; of a wait that lasts, the log tells.

    Raises:
        RunFolderError: another process does, naming it; or the folder cannot be written to.
    """
    key = _enter_within(folder, LOCK_FILE, wait_s)
    try:
        yield
    finally:
        _leave(folder, key)


@contextmanager
def output_lock(path: Path, wait_s: float = LockTuning.wait_s) -> Iterator[None]:
    """This process alone writes a file, or the files of a folder, within the block; others of the same name wait.

    Args:
        path: of the output, which need not exist. Where its folder does not, nobody writes there yet; where nothing
            can be written beside it, nobody waits.
        wait_s: seconds to wait for another process.

    Raises:
        RunFolderError: another process is still at it.
    """
    path = path.resolve()
    if not path.name or not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        yield
        return
    key = _enter_within(path.parent, f".{path.name[:200]}.lock", wait_s)
    try:
        yield
    finally:
        _leave(path.parent, key)


def _enter_within(folder: Path, name: str, wait_s: float) -> _Key:
    """As `_enter`, after waiting for the writers before."""
    start, told = time.monotonic(), False
    while True:
        try:
            return _enter(folder, name)
        except FolderInUse as refusal:
            waited = time.monotonic() - start
            if waited >= wait_s:
                raise
            if waited > LockTuning.quiet_s and not told:
                told = True
                _log.warning("note: %s; waiting for it", printable(str(refusal).partition(";")[0]))
            time.sleep(0.02)


def writer_of(folder: Path) -> int | None:
    """Number of the process that has locked a folder, 0 if it does not say; None: no one but perhaps this one."""
    path = folder / LOCK_FILE
    try:
        stat = folder.stat()
        if (stat.st_dev, stat.st_ino, LOCK_FILE) in _held or fcntl is None:
            return None
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | getattr(os, "O_NOFOLLOW", 0))  # of a pipe, too
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return None if error.errno in _UNABLE else _process(descriptor)
    finally:
        os.close(descriptor)
    return None


def refuse_other_writers(folder: Path) -> None:
    """Raises RunFolderError if another process has locked a folder."""
    process = writer_of(folder)
    if process is not None:
        raise _refusal(path=folder / LOCK_FILE, process=process)


def _refusal(path: Path, process: int) -> FolderInUse:
    who, folder = f"process {process}" if process else "another process", path.parent
    if path.name != LOCK_FILE:
        output = folder / path.name.removeprefix(".").removesuffix(".lock")
        return FolderInUse(f"{output}: {who} is writing it; wait for it, or choose another name")
    return FolderInUse(f"{folder}: {who} is writing a run there; wait for it, or choose another folder")


def _enter(folder: Path, name: str) -> _Key:
    with _guard:
        try:
            stat = folder.stat()
            key = (stat.st_dev, stat.st_ino, name)
            if key in _held:
                _held[key][0] += 1
            else:
                _held[key] = [1, _lock(folder / name)]
        except OSError as error:
            raise RunFolderError(f"{folder}: cannot be written to: {error.strerror or error}") from None
        return key


def _lock(path: Path) -> int:
    """A descriptor that holds the lock. Raises RunFolderError if its file may be somebody's."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            refuse_shared_file(path, os.fstat(descriptor))
        except RunFolderError:
            os.close(descriptor)
            raise
        try:
            if fcntl is not None:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in _UNABLE:
                process = _process(descriptor)
                os.close(descriptor)
                raise _refusal(path, process) from None
        with suppress(FileNotFoundError):
            if os.path.samestat(path.stat(), os.fstat(descriptor)):  # not removed by the one who had it before
                os.truncate(descriptor, 0)
                os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
                return descriptor
        os.close(descriptor)


def _process(descriptor: int) -> int:
    """What the lock's file says of its holder; 0: nothing."""
    try:
        return int(os.pread(descriptor, 32, 0))
    except (OSError, ValueError):
        return 0


def _leave(folder: Path, key: _Key) -> None:
    with _guard:
        _held[key][0] -= 1
        if _held[key][0]:
            return
        _, descriptor = _held.pop(key)
        with suppress(OSError):
            if os.path.samestat((folder / key[2]).stat(), os.fstat(descriptor)):
                (folder / key[2]).unlink()
        os.close(descriptor)
