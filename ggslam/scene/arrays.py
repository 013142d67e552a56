# SPDX-License-Identifier: Apache-2.0
"""Named arrays in NumPy's .npz files."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

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


def _read(path: str | Path, content: str, chosen: Callable[[Any], Any]) -> Any:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return chosen(arrays)
    except FileNotFoundError:
        raise FormatError(f"{path}: file is missing") from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise FormatError(f"{path}: not {content} written by ggslam: {error}") from None
