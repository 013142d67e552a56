# SPDX-License-Identifier: Apache-2.0
"""One writer at a time in a folder: a file that is locked while it writes, and that says who it is.

The system lets go of the lock when the process ends, however it ends: nothing is left that somebody has to remove.
"""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ggslam.errors import RunFolderError

try:
    import fcntl
except ImportError:  # no such locks on this system
    fcntl = None  # type: ignore[assignment]

LOCK_FILE = ".lock"
_UNABLE = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL)
"""File systems that have no locks."""

_held: dict[tuple[int, int], list[int]] = {}
"""Folders (device and inode) that this process has locked: how many times over, and by which descriptor."""
_guard = threading.Lock()


@contextmanager
def folder_lock(folder: Path, wait_s: float = 0.0) -> Iterator[None]:
    """This process alone writes to a folder within the block. Blocks may be nested.

    Args:
        folder: which must exist.
        wait_s: seconds to wait for another process.

    Raises:
        RunFolderError: another process does, naming it; or the folder cannot be written to.
    """
    last = time.monotonic() + wait_s
    while writer_of(folder) is not None and time.monotonic() < last:
        time.sleep(0.02)
    key = _enter(folder)
    try:
        yield
    finally:
        _leave(folder, key)


def writer_of(folder: Path) -> int | None:
    """Number of the process that has locked a folder, 0 if it does not say; None: no one but perhaps this one."""
    path = folder / LOCK_FILE
    try:
        stat = folder.stat()
        if (stat.st_dev, stat.st_ino) in _held or fcntl is None:
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
        raise _refusal(folder, process)


def _refusal(folder: Path, process: int) -> RunFolderError:
    who = f"process {process}" if process else "another process"
    return RunFolderError(f"{folder}: {who} is writing a run there; wait for it, or choose another folder")


def _enter(folder: Path) -> tuple[int, int]:
    with _guard:
        try:
            stat = folder.stat()
            key = (stat.st_dev, stat.st_ino)
            if key in _held:
                _held[key][0] += 1
            else:
                _held[key] = [1, _lock(folder)]
        except OSError as error:
            raise RunFolderError(f"{folder}: cannot be written to: {error.strerror or error}") from None
        return key


def _lock(folder: Path) -> int:
    """A descriptor that holds the lock."""
    path = folder / LOCK_FILE
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            if fcntl is not None:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in _UNABLE:
                process = _process(descriptor)
                os.close(descriptor)
                raise _refusal(folder, process) from None
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


def _leave(folder: Path, key: tuple[int, int]) -> None:
    with _guard:
        _held[key][0] -= 1
        if _held[key][0]:
            return
        _, descriptor = _held.pop(key)
        with suppress(OSError):
            if os.path.samestat((folder / LOCK_FILE).stat(), os.fstat(descriptor)):
                (folder / LOCK_FILE).unlink()
        os.close(descriptor)
