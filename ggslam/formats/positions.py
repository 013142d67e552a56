# SPDX-License-Identifier: Apache-2.0
"""Points without a position: sensors write NaN where they saw nothing, and every reader of clouds leaves these out."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from ggslam.errors import FormatError

_log = logging.getLogger(__name__)


def placed_rows(path: str | Path, points: np.ndarray, tell: bool = True) -> np.ndarray | slice:
    """Picks the points of a file that have a position, three finite numbers, and warns how many have none.

    Args:
        path: the file, for the message.
        points: [N, 3], as stored.
        tell: whether to warn.

    Returns:
        What to index the points and all that belongs to them with: bool [N], or a slice of everything.

    Raises:
        FormatError: there are points, but none has a position.
    """
    finite = np.isfinite(points).all(1)
    kept = int(finite.sum())
    if kept == len(points):
        return slice(None)
    if not kept:
        raise FormatError(f"{path}: none of its {len(points)} points has a position: they are not finite numbers")
    if tell:
        _log.warning("warning: %s: %s", path, left_out_words(len(points) - kept, len(points)))
    return np.asarray(finite)


def left_out_words(left_out: int, count: int) -> str:
    """What is said of so many points of a file without a position."""
    return f"left out {left_out} of {count} points that have no position (not a number)"
