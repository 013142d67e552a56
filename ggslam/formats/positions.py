# SPDX-License-Identifier: Apache-2.0
"""Points without a position: sensors write NaN where they saw nothing, and every reader of clouds leaves these out.
And positions that a file in single precision has rounded, as UTM coordinates to half a metre."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from ggslam.errors import NoPointsError
from ggslam.system.tuning import Tuning

_log = logging.getLogger(__name__)


class PositionTuning(Tuning):
    """When rounded positions are reported."""

    coarse_m = 1e-3
    """Step of coordinates above which a note says so, in metres."""


def placed_rows(path: str | Path, points: np.ndarray, tell: bool = True) -> np.ndarray | slice:
    """Picks the points of a file that have a position, three finite numbers, and warns how many have none, and if they
    are too far from zero for the precision of the file.

    Args:
        path: the file, for the message.
        points: [N, 3], as stored.
        tell: whether to warn.

    Returns:
        What to index the points and all that belongs to them with: bool [N], or a slice of everything.

    Raises:
        NoPointsError: there are points, but none has a position.
    """
    finite = np.isfinite(points).all(1)
    kept = int(finite.sum())
    if tell and kept and points.dtype == np.float32 and (words := rounded_words(points[finite])):
        _log.warning("warning: %s: %s", path, words)
    if kept == len(points):
        return slice(None)
    if not kept:
        raise NoPointsError(f"{path}: none of its {len(points)} points has a position: they are not finite numbers")
    if tell:
        _log.warning("warning: %s: %s", path, left_out_words(len(points) - kept, len(points)))
    return np.asarray(finite)


def coordinate_step(coordinate: float) -> float:
    """Metres between a coordinate and the next one in single precision; 0 if it is no number or too large for one."""
    with np.errstate(over="ignore"):
        step = float(np.spacing(np.float32(abs(coordinate))))
    return step if np.isfinite(step) else 0.0


def rounded_words(points: np.ndarray) -> str:
    """What is said of finite positions [n, 3] in single precision that are too far from zero for it; else empty."""
    farthest = float(np.median(np.abs(points), axis=0).max(initial=0))  # some may be anywhere
    step = coordinate_step(farthest)
    if step <= PositionTuning.coarse_m:
        return ""
    return (
        f"its coordinates reach {farthest:.0f} and are in single precision, which has steps of {step:.3g} there: "
        "points have lost their places; write doubles, or coordinates from an origin near by"
    )


def left_out_words(left_out: int, count: int) -> str:
    """What is said of so many points of a file without a position."""
    return f"left out {left_out} of {count} points that have no position (not a number)"
