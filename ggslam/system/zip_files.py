# SPDX-License-Identifier: Apache-2.0
"""Reads zip archives from untrusted sources: opened like any untrusted file, members read within a limit."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ggslam.errors import FormatError, GgslamError
from ggslam.system.untrusted_files import open_untrusted

PLAIN_WAYS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Ways to pack a member whose reader makes no more than it is asked for; LZMA's and bzip2's make all of it at once."""
ZIP_DAMAGE = (OSError, EOFError, ValueError, RuntimeError, NotImplementedError, OverflowError, zipfile.BadZipFile,
              zlib.error)  # fmt: skip
"""What Python's reader raises for damaged, encrypted or strange archives."""


@contextmanager
def open_zip(path: str | Path, error: type[GgslamError] = FormatError) -> Iterator[zipfile.ZipFile]:
    """A zip archive, open; `ZIP_DAMAGE` says what reading its members raises.

    Raises:
        error: as `open_untrusted`.
        BadZipFile, ValueError: no whole archive, or a member is packed in a way that is not read.
    """
    with open_untrusted(path, error) as file, zipfile.ZipFile(file) as archive:
        check_zip(archive)
        yield archive


def check_zip(archive: zipfile.ZipFile) -> None:
    """Raises ValueError if a member is encrypted, or packed so that more than is asked for may be unpacked."""
    for member in archive.infolist():
        if member.flag_bits & 1:
            raise ValueError(f"{member.filename} is encrypted")
        if member.compress_type not in PLAIN_WAYS:
            raise ValueError(f"{member.filename} is packed by a method that is not read ({member.compress_type})")


def read_member(archive: zipfile.ZipFile, member: str | zipfile.ZipInfo, limit: int) -> bytes:
    """The bytes of a member.

    Raises:
        KeyError: there is none of this name.
        ValueError: it has more than `limit` bytes.
        Exception: of `ZIP_DAMAGE`.
    """
    info = archive.getinfo(member) if isinstance(member, str) else member
    if info.file_size > limit:
        raise ValueError(f"{info.filename} has {info.file_size:,} bytes; at most {limit:,} are read")
    with archive.open(info) as opened:
        return opened.read(info.file_size)
