# SPDX-License-Identifier: Apache-2.0
"""Numbers in the text variants of file formats."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ggslam.errors import FormatError


def parse_numbers(words: Sequence[bytes], what: str, path: Path) -> np.ndarray:
    """Words as float64 [len(words)].

    Raises:
        FormatError: one is no number; names the file and `what`.
    """
    try:
        return np.fromiter(map(float, words), np.float64, len(words))
    except ValueError as error:
        raise FormatError(f"{path}: {what}: {error}") from None


def fit(values: np.ndarray, code: str, name: str, path: Path) -> np.ndarray:
    """Values in their declared numpy type `code` ("u1", "f4", ...); an integer type must hold integers of its range.

    Raises:
        FormatError: a value does not fit; names the file and the property `name`.
    """
    if code.startswith("f"):
        with np.errstate(over="ignore"):
            return values.astype(code)
    limits = np.iinfo(code)
    fits = (values >= limits.min) & (values <= limits.max) & (values == np.rint(values))
    if not fits.all():
        raise FormatError(f"{path}: property '{name}': {values[~fits][0]} does not fit its type {np.dtype(code)}")
    return values.astype(code)
