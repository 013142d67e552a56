# SPDX-License-Identifier: Apache-2.0
"""A file of arrays and a tree of plain values beside them, with a checksum: written once, read whole, never executed.

Layout: magic, length of the header (uint64), header (JSON: table of the arrays, values), the arrays one after the other
at multiples of 64 bytes, and the CRC-32 of everything before it (uint32). Numbers are little-endian.
"""

from __future__ import annotations

import json
import math
import os
import struct
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from ggslam.errors import FormatError
from ggslam.system.atomic import write_failure
from ggslam.system.links import new_file
from ggslam.system.untrusted_files import FileTuning, open_untrusted

_MAGIC = b"ggstate1"
_ALIGNMENT: Final = 64
"""Bytes that arrays are aligned to in the file."""
_KINDS = "biufc"
_WIDEST: Final = 32
"""Bytes of numpy's widest number."""


@dataclass(frozen=True)
class WrittenFile:
    """What tells a file from a damaged one: its name, number of bytes, CRC-32."""

    name: str
    size: int
    crc: int


@dataclass(frozen=True)
class PendingFile:
    """A file that is written, but under a temporary name and perhaps not on the disk yet.

    Attributes:
        path: what it is to be called.
        temporary: what it is called.
        written: what it holds.
    """

    path: Path
    temporary: Path
    written: WrittenFile

    def finish(self) -> None:
        """Waits until it is on the disk, and gives it its name. May be called in another thread.

        Raises:
            RunFolderError: it cannot be written.
        """
        try:
            with self.temporary.open("rb+") as file:
                os.fsync(file.fileno())
            self.temporary.replace(self.path)
        except OSError as error:
            self.discard()
            raise write_failure(self.path, error) from error

    def discard(self) -> None:
        """Removes it."""
        with suppress(OSError):
            self.temporary.unlink(missing_ok=True)


def write_array_file(path: Path, values: Any, arrays: Sequence[np.ndarray]) -> PendingFile:
    """Writes a file that `read_array_file` reads; `finish` it.

    Args:
        path: of the file; what is there is replaced only when the new one is whole.
        values: what JSON can say; floats may be NaN or infinite.
        arrays: of numbers or truth values; any strides.

    Raises:
        RunFolderError: it cannot be written.
    """
    table, place = [], 0
    for array in arrays:
        table.append([array.dtype.str, list(array.shape), place])
        place += -(-array.nbytes // _ALIGNMENT) * _ALIGNMENT
    header = json.dumps({"arrays": table, "values": values}, separators=(",", ":")).encode()
    header += b" " * (-(len(_MAGIC) + 8 + len(header)) % _ALIGNMENT)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with new_file(temporary) as file:
            out = _Summed(file)
            out.write(_MAGIC + struct.pack("<Q", len(header)) + header)
            for array in arrays:
                out.write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
                out.write(bytes(-array.nbytes % _ALIGNMENT))
            crc = out.crc
            out.write(struct.pack("<I", crc))
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise write_failure(path, error) from error
    return PendingFile(path, temporary, WrittenFile(path.name, out.size, crc))


class _Summed:
    """Counts and sums up what is written."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self.size, self.crc = file, 0, 0

    def write(self, data: bytes | memoryview) -> None:
        view = memoryview(data)
        while len(view):
            done = self._file.write(view[: FileTuning.bytes_at_once])
            self.crc = zlib.crc32(view[:done], self.crc)
            self.size += done
            view = view[done:]


def read_array_file(path: Path, expected: WrittenFile | None = None) -> tuple[Any, list[np.ndarray]]:
    """The values and arrays of a file; the arrays may be changed.

    Args:
        path: of the file.
        expected: what writing it gave; None: the sum in the file is all there is to hold it against.

    Raises:
        FormatError: it is missing, damaged or another one than expected.
    """
    try:
        with open_untrusted(path) as file:
            size = os.fstat(file.fileno()).st_size
            if expected is not None and size != expected.size:
                raise ValueError(f"expected {expected.size} bytes, found {size}")
            return _read(file, size, expected)
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError, MemoryError) as error:
        raise FormatError(f"{path}: damaged: {error}") from None


def _read(file: IO[bytes], size: int, expected: WrittenFile | None) -> tuple[Any, list[np.ndarray]]:
    crc, start = 0, _take(file, len(_MAGIC) + 8)
    length = struct.unpack("<Q", start[len(_MAGIC) :])[0]
    if start[: len(_MAGIC)] != _MAGIC or not 0 < length <= size:
        raise ValueError("not a file of this kind")
    text = _take(file, length)
    crc = zlib.crc32(text, zlib.crc32(start))
    header = json.loads(text)
    arrays, place = [], 0
    left = size - len(start) - length - 4
    for code, shape, begin in header["arrays"]:
        kind = np.dtype(code)
        count = math.prod(shape)
        padded = -(-count * kind.itemsize // _ALIGNMENT) * _ALIGNMENT
        if kind.kind not in _KINDS or kind.itemsize > _WIDEST or begin != place or min([0, *shape]) < 0:
            raise ValueError("an array of an unknown kind")
        if place + padded > left:  # before memory is allocated
            raise ValueError("it ends too early")
        array = np.empty(padded // kind.itemsize if count else 0, kind)
        crc = _fill(file, array, crc)
        arrays.append(array[:count].reshape(shape))
        place += padded
    found = struct.unpack("<I", _take(file, 4))[0]
    if place != left or crc != found or (expected is not None and crc != expected.crc):
        raise ValueError("its sum is not what it should be")
    return header["values"], arrays


def _take(file: IO[bytes], count: int) -> bytes:
    data = b""
    while len(data) < count:
        more = file.read(count - len(data))
        if not more:
            raise ValueError("it ends too early")
        data += more
    return data


def _fill(file: IO[bytes], array: np.ndarray, crc: int) -> int:
    """Reads an array, padding included; returns the sum so far."""
    view = memoryview(array.view(np.uint8).data) if array.size else memoryview(b"")
    done = 0
    while done < len(view):
        read = file.readinto(view[done : done + FileTuning.bytes_at_once])  # type: ignore[attr-defined]
        if not read:
            raise ValueError("it ends too early")
        crc = zlib.crc32(view[done : done + read], crc)
        done += read
    return crc
