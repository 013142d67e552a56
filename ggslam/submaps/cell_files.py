# SPDX-License-Identifier: Apache-2.0
"""The files of a grid store: one folder per cell, in it one folder per version, in it one file per part.

    cells/3_0_-2/17/points.pcd

A version is written whole before the index speaks of it, and versions that the index does not speak of are leftovers.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import IO

import numpy as np

from ggslam.errors import FormatError, RunFolderError
from ggslam.submaps.cell_keys import CellKey
from ggslam.system.atomic import write_failure
from ggslam.system.links import refuse_link, refuse_shared_file
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import open_untrusted, read_untrusted


class CellFileTuning(Tuning):
    """Reading and writing of cells."""

    threads = 8
    """Threads that wait for the disk."""
    lock_tries = 10
    """Attempts to lock a store: who only asks whether it is locked holds the lock for a moment."""
    between_tries_s = 0.01
    """Seconds between them."""


_CELL = re.compile(r"(-?\d{1,10})_(-?\d{1,10})_(-?\d{1,10})", re.ASCII)
_PART = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


def is_part_name(name: str) -> bool:
    """Whether a part of a cell may be called so: a plain file name."""
    return _PART.fullmatch(name) is not None


class CellFiles:
    """Reads, writes and clears the folder `cells` of a store."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, key: CellKey, version: int, part: str) -> Path:
        """Where a part lies.

        Raises:
            FormatError: its name or a link leads out of the store.
        """
        if not _PART.fullmatch(part) or not isinstance(version, int):
            raise FormatError(f"{self.folder}: cell {key}: {part!r}, version {version!r}: not a part of a cell")
        path = self._own(key) / str(version) / part
        if path.is_symlink() or path.parent.is_symlink():
            raise FormatError(f"{path}: is a link, or lies in one")
        return path

    def write(self, versions: Mapping[tuple[CellKey, int], Mapping[str, bytes]]) -> None:
        """Writes new versions of cells and waits until they and their names are on the disk.

        Raises:
            RunFolderError: something cannot be written; leftovers stay.
            ValueError: the name of a part is no plain file name.
        """
        for parts in versions.values():
            if bad := [name for name in parts if not is_part_name(name)]:
                raise ValueError(f"not a name for a part of a cell: {bad[0]!r}")
        written, folders = [], {self.folder: None}
        path = self.folder
        try:
            for (key, version), parts in versions.items():
                path = self._own(key) / str(version)
                path.mkdir(parents=True)
                folders |= {path: None, path.parent: None}
                for name, data in parts.items():
                    path = self.path(key, version, name)
                    path.write_bytes(data)
                    written.append(path)
        except OSError as error:
            raise write_failure(path, error) from error
        # All are waited for at once: the file system commits its journal once for many instead of once for each.
        with ThreadPoolExecutor(CellFileTuning.threads) as pool:
            list(pool.map(wait_for_disk, [*written, *folders]))

    def sweep(self, key: CellKey, kept: Mapping[str, int]) -> None:
        """Removes a cell's files, except the versions to keep of its parts. What cannot be removed stays, and so does
        what lies behind a link."""
        with suppress(OSError, FormatError):
            cell = self._own(key)
            for folder in list(cell.iterdir()):
                if folder.is_symlink() or not folder.is_dir():
                    folder.unlink()
                    continue
                parts = {name for name, version in kept.items() if str(version) == folder.name}
                if not parts:
                    shutil.rmtree(folder, ignore_errors=True)
                    continue
                for file in list(folder.iterdir()):
                    if file.name not in parts:
                        file.unlink()
            if not kept:
                cell.rmdir()

    def cells(self) -> Iterator[CellKey]:
        """Every cell that has a folder."""
        with suppress(FileNotFoundError):
            for entry in self.folder.iterdir():
                if match := _CELL.fullmatch(entry.name):
                    yield int(match[1]), int(match[2]), int(match[3])

    def _own(self, key: CellKey) -> Path:
        """The folder of a cell. Raises FormatError if it, or the folder of all cells, is a link, or the cell is none
        (an index from elsewhere may hold anything)."""
        if not all(isinstance(number, (int, np.integer)) for number in key):
            raise FormatError(f"{self.folder}: {key!r} is not a cell")
        cell = self.folder / "_".join(map(str, key))
        for path in (self.folder, cell):
            if path.is_symlink():
                raise FormatError(f"{path}: is a link; a store holds none")
        return cell


class WriterLock:
    """Held by the one writer of a store: a file, locked by the operating system as long as its process lives.

    While it is held the file names the process; a name found in it is that of a writer which ended without `release`.

    Raises:
        RunFolderError: another writer has it, or the file cannot be written or may be somebody's (a hard link).
    """

    def __init__(self, path: Path) -> None:
        refuse_link(path)
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise write_failure(path, error) from error
        try:
            refuse_shared_file(path, os.fstat(handle))
        except RunFolderError:
            os.close(handle)
            raise
        self._file = os.fdopen(handle, "a+b")
        try:
            _lock(self._file)
        except OSError as error:
            owner = self._content()
            self._file.close()
            if isinstance(error, BlockingIOError):
                raise RunFolderError(f"{path.parent}: is being written to by process {owner or 'unknown'}") from None
            raise write_failure(path, error) from error
        self.unfinished = bool(self._content())
        self._fill(path, str(os.getpid()))

    def release(self) -> None:
        """Lets others write; nothing unfinished is left behind."""
        with suppress(OSError):
            self._file.truncate(0)
        self._file.close()

    def abandon(self) -> None:
        """Lets others write, who will look for what is left unfinished."""
        self._file.close()

    def _content(self) -> str:
        self._file.seek(0)
        return self._file.read(64).decode("ascii", "replace").strip()

    def _fill(self, path: Path, text: str) -> None:
        try:
            self._file.truncate(0)
            self._file.write(text.encode("ascii"))
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            with suppress(OSError):
                self._file.close()
            raise write_failure(path, error) from error


def _lock(file: IO[bytes]) -> None:
    """Raises OSError if somebody else has it."""
    for left in reversed(range(CellFileTuning.lock_tries)):
        try:
            return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if not left:
                raise
            time.sleep(CellFileTuning.between_tries_s)


def is_locked(path: Path) -> bool:
    """Whether a `WriterLock` of this file is held."""
    try:
        with open_untrusted(path) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except (FormatError, OSError):  # nobody ever wrote, or the file system has no locks
        return False
    return False


def read_current(find: Callable[[], tuple[Path, int]], attempts: int = 5) -> tuple[Path, bytes]:
    """Reads the file that `find` names, asking again if a writer has replaced it meanwhile.

    Args:
        find: gives the file, and how many bytes it is to have.
        attempts: how often to ask again.

    Raises:
        OSError: it cannot be read.
        FormatError: it is of another size, and was not read, or is no regular file.
    """
    path, size = find()
    for _ in range(attempts):
        try:
            return path, _content(path, size)
        except FileNotFoundError:
            found = find()
            if found[0] == path:
                raise
            path, size = found
    return path, _content(path, size)


def _content(path: Path, size: int) -> bytes:
    """Of a part. Raises FormatError if it is no regular file or of another size, FileNotFoundError if there is none."""
    found = path.stat()
    if stat.S_ISREG(found.st_mode) and found.st_size != size:  # before it is read: it may be a huge file of holes
        raise FormatError(f"{path}: damaged: {found.st_size} bytes, the index says {size}")
    try:
        return read_untrusted(path)
    except FormatError:
        path.lstat()
        raise


def wait_for_disk(path: Path) -> None:
    """Waits until a file's content, or the names in a folder, are on the disk.

    Raises:
        RunFolderError: they cannot be; names it and the reason.
    """
    try:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        raise write_failure(path, error) from error
