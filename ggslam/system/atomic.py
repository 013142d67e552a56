# SPDX-License-Identifier: Apache-2.0
"""Writes files that appear whole or not at all."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ggslam.errors import RunFolderError
from ggslam.system.links import refuse_link

_MACHINE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG)
"""Not the user's fault: disk full, quota used up, disk broken, file larger than the disk or `ulimit -f` allows."""


@contextmanager
def atomic_write(path: str | Path, fsync: bool = False, follow: bool = True) -> Iterator[Path]:
    """Gives the name of a temporary file to fill; it takes the place of `path` when the block ends well.

        with atomic_write("map.ply") as temporary:
            temporary.write_bytes(data)

    The temporary file lies in the folder of `path` (a rename is atomic only within one file system), is hidden, and
    ends like `path`, so that writers which go by the ending (images) work too. It exists and is empty when the block
    begins. If the block raises, whatever stood at `path` before is untouched and the temporary file is gone.

    Args:
        path: the file to write; its folder must exist.
        fsync: also waits until the data are on the disk, so that a power cut cannot leave an empty file.
        follow: a link at `path`, which a user named, keeps pointing, and what it points to is replaced. False: it is
            refused, for `path` is a file of ggslam's own in a folder that may come from elsewhere.

    Raises:
        RunFolderError: the file cannot be written (folder missing, no permission, disk full, ...), naming `path` and
            the reason of the operating system.
    """
    path = Path(path)
    if not follow:
        refuse_link(path)
    if path.exists() and not path.is_file():
        raise RunFolderError(f"cannot write {path}: it exists and is not a regular file")
    path = path.resolve() if path.is_symlink() else path
    temporary = path.with_name(f".{path.stem[:64]}.{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
    try:
        temporary.open("xb").close()
        yield temporary
        if fsync:
            _sync(temporary)
        temporary.replace(path)
    except OSError as error:
        if error.filename not in (None, str(temporary), temporary):
            raise  # the block failed to read some other file: not ours to explain
        raise write_failure(path, error) from error
    finally:
        with suppress(OSError):  # a file system that cannot be written: the reason above is the one to tell
            temporary.unlink(missing_ok=True)


def write_bytes(path: str | Path, data: bytes, fsync: bool = False, follow: bool = True) -> None:
    """Writes a whole file atomically; see `atomic_write` for errors."""
    with atomic_write(path, fsync, follow) as temporary:
        temporary.write_bytes(data)


def write_text(path: str | Path, text: str, fsync: bool = False, follow: bool = True) -> None:
    """Writes a whole UTF-8 text file atomically; see `atomic_write` for errors."""
    write_bytes(path, text.encode("utf-8"), fsync, follow)


def sync_folder(path: str | Path) -> None:
    """Waits until the names in a folder are on the disk, where the system can tell."""
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def make_folder(path: str | Path) -> None:
    """Makes a folder and those above it, if they are not there.

    Raises:
        RunFolderError: it cannot be made, naming it and the reason of the operating system.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(f"{path}: cannot be made: {error.strerror or error}") from None


def make_empty_folder(path: str | Path) -> None:
    """Makes a folder for files that must not lie among those of an earlier time.

    Raises:
        RunFolderError: there is something already, or it cannot be made.
    """
    path = Path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise RunFolderError(f"{path}: exists and is not an empty folder; choose another one with `out`")
    make_folder(path)


def write_failure(path: str | Path, error: OSError) -> RunFolderError:
    """The error to raise when the operating system would not write `path`; a full or broken disk is not the user's."""
    failure = RunFolderError(f"cannot write {path}: {reason_of(error)}")
    if is_machine_error(error):
        failure.exit_code = 1
    return failure


def is_machine_error(error: OSError) -> bool:
    """Whether the machine is at fault, not whoever named the file."""
    return error.errno in _MACHINE_ERRORS


def reason_of(error: OSError) -> str:
    """Why the operating system refused, in words and without a number."""
    return str(error.strerror or error)


def _sync(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
