# SPDX-License-Identifier: Apache-2.0
"""Reads files from untrusted sources: within a size limit, and never through a name that leads out of their folder.

Recordings, runs, stores and streams are passed around, so nothing in them is trusted: not a size, not a name, not the
kind of a file. Whoever reads one reads it through here.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Final

from ggslam.errors import FormatError, GgslamError, MemoryFullError, SequenceError
from ggslam.system.missing_paths import why_missing
from ggslam.system.process_memory import most_memory_bytes
from ggslam.system.tuning import Tuning


class FileTuning(Tuning):
    """Limits on hostile files, and how they are read."""

    max_text_bytes = 256 << 20
    """Largest text file: a trajectory of a day at 30 frames/s has 200 MB."""
    max_image_bytes = 256 << 20
    """Largest image file."""
    bytes_at_once = 1 << 20
    """Bytes that are read or written at a time."""
    shown_characters = 60
    """Characters of a far too long path that are shown."""


_LONGEST_NAME: Final = 255
"""Bytes of a file's name, on all usual file systems."""
_LONGEST_PATH: Final = 4096
"""Bytes of a path in Linux, with a zero byte behind it."""


def given_path(path: str | Path, error: type[GgslamError] = SequenceError, where: str = "") -> Path:
    """A path as somebody wrote it, with `~` for a home; that of an unknown user stays as it is.

    Args:
        path: mostly of a recording, or of what belongs to one.
        error: class of the error to raise.
        where: the file and entry that name the path, for the message.

    Raises:
        error: it is no path, or no file can have it: it, or a name in it, is too long, or it has a zero byte.
    """
    shown = f"{where}: " if where else ""
    if not isinstance(path, (str, os.PathLike)) or not isinstance(os.fspath(path), str):
        raise error(f"{shown}expected a path, found {type(path).__name__}")
    text = os.fspath(path)
    shown += repr(text if len(text) <= FileTuning.shown_characters else text[: FileTuning.shown_characters] + "...")
    if "\0" in text:
        raise error(f"{shown}: a path cannot have a zero byte")
    try:
        sizes = [len(os.fsencode(name)) for name in text.split("/")]
    except UnicodeEncodeError:
        raise error(f"{shown}: a path cannot have these characters") from None
    if max(sizes) > _LONGEST_NAME or sum(sizes) + len(sizes) > _LONGEST_PATH:
        raise error(f"{shown}: too long for a path: {len(text):,} characters")
    return Path(os.path.expanduser(path))  # noqa: PTH111 (Path's raises for unknown users)


def open_untrusted(path: str | Path, error: type[GgslamError] = FormatError) -> BinaryIO:
    """Opens a regular file for reading; a pipe, a device or a folder of that name is refused, not waited for.

    Args:
        path: of the file.
        error: class of the error to raise.

    Raises:
        error: it is missing, no regular file, or cannot be read; names it and the reason.
    """
    try:
        _refuse_other_kinds(path, Path(path).stat().st_mode, error)  # opening a device may already do something
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise error(f"{path}: {why_missing(path, 'file is missing')}") from None
    except (OSError, ValueError) as reason:  # ValueError: a name with a zero byte
        raise error(f"{path}: cannot be read: {getattr(reason, 'strerror', None) or reason}") from None
    try:
        _refuse_other_kinds(path, os.fstat(handle).st_mode, error)
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def _refuse_other_kinds(path: str | Path, mode: int, error: type[GgslamError]) -> None:
    if not stat.S_ISREG(mode):
        raise error(f"{path}: is {'a folder, ' if stat.S_ISDIR(mode) else ''}not a regular file")


def read_untrusted(path: str | Path, limit: int | None = None, error: type[GgslamError] = FormatError) -> bytes:
    """The bytes of a regular file, as many as it has when it is opened.

    Args:
        path: of the file.
        limit: bytes it may have; None: as many as this machine can hold.
        error: class of the error to raise.

    Raises:
        error: as `open_untrusted`, or larger than `limit`.
        MemoryFullError: a file that could be held was not, for memory is full.
    """
    with open_untrusted(path, error) as file:
        size = _size_within(file, path, limit, error)
        try:
            return file.read(size) or b""  # None: of some files in /proc, without a size
        except OSError as reason:
            raise error(f"{path}: cannot be read: {reason.strerror or reason}") from None
        except MemoryError:
            raise MemoryFullError(f"{path}: memory is full: no room for its {size:,} bytes") from None


def _size_within(file: BinaryIO, path: str | Path, limit: int | None, error: type[GgslamError]) -> int:
    size = os.fstat(file.fileno()).st_size
    most = most_memory_bytes() if limit is None else limit
    if size > most:
        raise error(f"{path}: too large for what it is: {size:,} bytes, at most {most:,} are read")
    return size


def copy_untrusted(
    source: str | Path, target: Path, limit: int | None = None, error: type[GgslamError] = FormatError
) -> None:
    """Copies the content of a regular file, as many bytes as it has when it is opened.

    Args:
        source: the file.
        target: where to; what is there is replaced.
        limit: bytes it may have, so that a file of holes does not fill the disk; None: as many as this machine's
            memory has.
        error: class of the error to raise.

    Raises:
        error: as `read_untrusted`; nothing was written.
        OSError: `target` cannot be written.
    """
    with open_untrusted(source, error) as file:
        left = _size_within(file, source, limit, error)
        with target.open("wb") as copy:
            while left > 0:
                try:
                    block = file.read(min(left, FileTuning.bytes_at_once))
                except OSError as reason:
                    raise error(f"{source}: cannot be read: {reason.strerror or reason}") from None
                if not block:
                    break
                copy.write(block)
                left -= len(block)


def copy_untrusted_folder(
    source: Path, target: Path, limit: int | None = None, error: type[GgslamError] = FormatError
) -> None:
    """Copies the files of a folder and of those in it, each as `copy_untrusted` does; links in it are refused.

    Args:
        source: the folder.
        target: where to; made if it is not there.
        limit: bytes that each may have, see `copy_untrusted`.
        error: class of the error to raise.

    Raises:
        error: there is a link, or a file cannot be copied; names it and the reason.
        OSError: `target` cannot be written.
    """
    target.mkdir(exist_ok=True)
    for path in sorted(source.iterdir()):
        if path.is_symlink():
            raise error(f"{path}: is a link; files behind links are not copied")
        if path.is_dir():
            copy_untrusted_folder(path, target / path.name, limit, error)
        else:
            copy_untrusted(path, target / path.name, limit, error)


def read_untrusted_text(
    path: str | Path, error: type[GgslamError] = FormatError, limit: int = FileTuning.max_text_bytes
) -> str:
    """Text of a file in UTF-8, with or without a byte order mark; line ends become `\\n`.

    Raises:
        error: as `read_untrusted`, or not text.
    """
    try:
        text = read_untrusted(path, limit, error).decode("utf-8-sig")
    except UnicodeDecodeError as reason:
        raise error(f"{path}: cannot be read as text: {reason}") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def is_plain_name(name: object) -> bool:
    """Whether this is a name of a file in a folder, and nothing that leads elsewhere, is longer than names can be or
    has characters that the file system cannot write."""
    if not isinstance(name, str) or name in ("", ".", "..") or set(name) & {"/", "\\", "\0"}:
        return False
    try:
        return len(os.fsencode(name)) <= _LONGEST_NAME
    except UnicodeEncodeError:  # half a pair of UTF-16, which JSON can hold
        return False


def member(folder: str | Path, name: str, error: type[GgslamError] = FormatError) -> Path:
    """Path of a file that a description in `folder` names, relative to it; the file need not be there.

    Args:
        folder: that the description is of.
        name: relative path with `/`.
        error: class of the error to raise.

    Raises:
        error: the name leads out of the folder, by itself or through a link.
    """
    path = Path(folder) / name
    if "\0" in name:
        raise error(f"{folder}: names a file with a zero byte")
    if not path.resolve().is_relative_to(Path(folder).resolve()):
        raise error(f"{folder}: names {name}, which lies outside the folder")
    return path


def refuse_links(folder: str | Path, error: type[GgslamError] = FormatError, links: bool = False) -> None:
    """Looks through a folder, and those in it, for links that lead out of it, pipes, sockets and devices.

    Args:
        folder: may be a link itself: whoever names it has chosen so.
        error: class of the error to raise.
        links: links that lead out are no fault, and not followed.

    Raises:
        error: there is one; names it and, of a link, where it leads.
    """
    root = Path(folder).resolve()
    waiting = [str(root)]
    while waiting:
        with suppress(OSError), os.scandir(waiting.pop()) as entries:
            for entry in entries:
                if entry.is_symlink():
                    if links:
                        continue
                    target = Path(entry.path).resolve()
                    if not target.is_relative_to(root):
                        inner = Path(entry.path).relative_to(root)
                        raise error(f"{Path(folder) / inner}: is a link to {target}, outside {folder}{_advice(inner)}")
                elif entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)
                elif not entry.is_file(follow_symlinks=False):
                    raise error(f"{Path(folder) / Path(entry.path).relative_to(root)}: is not a regular file")


def _advice(inner: Path) -> str:
    """What to do with a link that people do not see unless they look for it."""
    return "; it may be deleted" if inner.name.startswith(".") else ""


def printable(text: str) -> str:
    """Text without control characters, which could move a terminal's cursor, colour it or rename it; tabs and line
    breaks stay."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in "\n\t" else f"\\x{ord(c):02x}" for c in text)
