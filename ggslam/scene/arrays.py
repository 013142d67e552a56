# SPDX-License-Identifier: Apache-2.0
"""Named arrays in NumPy's .npz files."""

from __future__ import annotations

import io
import math
import os
import tokenize
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
from numpy.lib import format as npy

from ggslam.errors import FormatError, GgslamError
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import open_untrusted
from ggslam.system.zip_files import ZIP_DAMAGE, check_zip, open_zip

T = TypeVar("T")


class ArrayLimits(Tuning):
    """Limits of compressed arrays in untrusted files."""

    max_bytes = 64 << 20
    """Bytes that compressed arrays may expand to, whatever the size of their file. ggslam writes arrays
    uncompressed."""
    max_ratio = 16
    """Largest expansion beyond that, in multiples of the file's size."""


def arrays_to_bytes(**arrays: np.ndarray) -> bytes:
    """Content of a file that `read_arrays` reads."""
    out = io.BytesIO()
    np.savez(out, **arrays)  # type: ignore[arg-type]
    return out.getvalue()


def read_array(path: str | Path, error: type[GgslamError] = FormatError) -> np.ndarray:
    """The array of a .npy file.

    Raises:
        error: missing, no array of numbers, or damaged; a header that claims more than the file holds included.
    """
    with open_untrusted(path, error) as file:
        try:
            shape, _, dtype = _read_header(file)
            if dtype.hasobject:
                raise ValueError("it holds Python objects")
            _check_claim(math.prod(shape) * dtype.itemsize, os.fstat(file.fileno()).st_size - file.tell())
            file.seek(0)
            return np.asarray(npy.read_array(file, allow_pickle=False))
        except _DAMAGE as reason:
            raise error(f"{path}: cannot be read: {reason}") from None


def read_all_arrays(path: str | Path, content: str) -> dict[str, np.ndarray]:
    """All arrays of a file by name; see `read_arrays`."""
    return _read(path, content, lambda arrays: {name: arrays[name] for name in arrays.files})


def read_arrays(path: str | Path, content: str, *names: str) -> list[np.ndarray]:
    """The arrays of these names.

    Args:
        path: of the file.
        content: what the file should be, for the message.

    Raises:
        FormatError: missing, damaged, or without one of them.
    """
    return _read(path, content, lambda arrays: [arrays[name] for name in names])


def array_blocks(path: str | Path, content: str, *names: str, rows: int) -> Iterator[list[np.ndarray]]:
    """The arrays of these names, as many rows of each at a time; arguments and errors as of `read_arrays`. They end
    with the shortest."""
    try:
        with open_zip(path) as archive, ExitStack() as stack:
            members = [_Member(stack.enter_context(archive.open(f"{name}.npy"))) for name in names]
            for _ in range(0, min(member.rows for member in members), rows):
                yield [member.read(rows) for member in members]
    except _DAMAGE as error:
        raise FormatError(f"{path}: not {content} written by ggslam: {error}") from None


class _Member:
    """An array of a file, read row by row."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        if npy.read_magic(file) != (1, 0):
            raise ValueError("an array has an unknown version")
        shape, fortran, self._dtype = npy.read_array_header_1_0(file)
        if self._dtype.hasobject or fortran or not shape:
            raise ValueError("an array has an unknown kind")
        self._shape, self.rows = shape[1:], shape[0]

    def read(self, rows: int) -> np.ndarray:
        size = math.prod(self._shape)
        values = np.frombuffer(self._file.read(rows * size * self._dtype.itemsize), self._dtype)
        return values.reshape(-1, *self._shape)


def _read(path: str | Path, content: str, chosen: Callable[[Any], T]) -> T:
    with open_untrusted(path) as file:
        return arrays_of(file, f"{path}: not {content} written by ggslam", chosen)


def arrays_of(file: IO[bytes], what: str, chosen: Callable[[Any], T]) -> T:
    """What `chosen` takes from the arrays of an open file, which is read and checked before anything large is made.

    Args:
        file: a .npz file.
        what: for the message: `what`: reason.
        chosen: takes arrays by name.

    Raises:
        FormatError: it is none, damaged, or expands to more than it may.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            check_zip(archive)
            members = archive.infolist()
            held = sum(member.compress_size for member in members)
            _check_claim(
                sum(member.file_size for member in members), max(ArrayLimits.max_bytes, ArrayLimits.max_ratio * held)
            )
            for member in members:
                _check_member(archive, member)
        file.seek(0)
        with np.load(file, allow_pickle=False) as arrays:
            return chosen(arrays)
    except _DAMAGE as error:
        raise FormatError(f"{what}: {error}") from None


def _check_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    with archive.open(member) as file:
        shape, _, dtype = _read_header(file)
    if dtype.kind not in "biufUS" or min(shape, default=0) < 0:
        raise ValueError(f"{member.filename} holds {dtype}, not numbers or text")
    _check_claim(math.prod(shape) * dtype.itemsize, member.file_size)


def _read_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order and type of an array; the file is left at its first byte."""
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    version = npy.read_magic(file)
    if version not in readers:
        raise ValueError(f"an array has the unknown version {version}")
    return readers[version](file)


def _check_claim(claimed: int, held: int) -> None:
    if claimed > held:
        raise ValueError(f"it claims {claimed:,} bytes of arrays, at most {held:,} are possible")


_DAMAGE = (*ZIP_DAMAGE, KeyError, TypeError, SyntaxError, RecursionError, tokenize.TokenError)
"""What Python's and NumPy's readers raise for damaged, encrypted or strange files."""
