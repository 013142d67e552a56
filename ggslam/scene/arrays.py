# SPDX-License-Identifier: Apache-2.0
"""Named arrays in NumPy's .npz files."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from ggslam.errors import FormatError


def arrays_to_bytes(**arrays: np.ndarray) -> bytes:
    """Content of a file that `read_arrays` reads."""
    out = io.BytesIO()
    np.savez(out, **arrays)  # type: ignore[arg-type]
    return out.getvalue()


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
        with zipfile.ZipFile(path) as archive, ExitStack() as stack:
            members = [_Member(stack.enter_context(archive.open(f"{name}.npy"))) for name in names]
            for _ in range(0, min(member.rows for member in members), rows):
                yield [member.read(rows) for member in members]
    except FileNotFoundError:
        raise FormatError(f"{path}: file is missing") from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise FormatError(f"{path}: not {content} written by ggslam: {error}") from None


class _Member:
    """An array of a file, read row by row."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        if npy.read_magic(file) != (1, 0):
            raise ValueError("an array of an unknown version")
        shape, fortran, self._dtype = npy.read_array_header_1_0(file)
        if self._dtype.hasobject or fortran or not shape:
            raise ValueError("an array of an unknown kind")
        self._shape, self.rows = shape[1:], shape[0]

    def read(self, rows: int) -> np.ndarray:
        size = math.prod(self._shape)
        values = np.frombuffer(self._file.read(rows * size * self._dtype.itemsize), self._dtype)
        return values.reshape(-1, *self._shape)


def _read(path: str | Path, content: str, chosen: Callable[[Any], Any]) -> Any:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return chosen(arrays)
    except FileNotFoundError:
        raise FormatError(f"{path}: file is missing") from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise FormatError(f"{path}: not {content} written by ggslam: {error}") from None
