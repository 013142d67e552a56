# SPDX-License-Identifier: Apache-2.0
"""Times as names of images and as first numbers of lines: in seconds, or in a thousandth, millionth or billionth."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ggslam.sequences.recording import ImageFile
from ggslam.system.clock_units import EPOCH_DIGITS, UNITS
from ggslam.system.tuning import Tuning


class StampTuning(Tuning):
    """How the unit of times is told."""

    max_step_s = 10.0
    """Longest time between two poses if nothing else tells the unit, in seconds."""


def times_of_names(files: Iterable[ImageFile]) -> np.ndarray | None:
    """Times that the names of images are, float64 [n], seconds: decimals, or whole numbers as long as a clock's since
    1970; None if they are none."""
    stems = [file.stem for file in files]
    lengths = {len(stem) for stem in stems}
    if len(lengths) == 1 and all(stem.isascii() and stem.isdigit() for stem in stems):
        unit = EPOCH_DIGITS.get(lengths.pop())
        if unit is None or any(stem.startswith("0") for stem in stems):  # KITTI numbers frames with ten digits
            return None
        return np.array([_exact_seconds(stem, unit) for stem in stems])
    try:
        times = np.array([float(stem) if "." in stem else np.nan for stem in stems])
    except ValueError:
        return None
    return times if len(times) and np.isfinite(times).all() else None


def _exact_seconds(digits: str, unit: str) -> float:
    """A whole number of units in seconds; nanoseconds since 1970 have more digits than a float."""
    places = {"s": 0, "ms": 3, "us": 6, "ns": 9}[unit]
    whole, part = (digits[:-places], digits[-places:]) if places else (digits, "0")
    return float(f"{whole}.{part}")


def unit_of_stamps(stamps: np.ndarray, times: np.ndarray | None) -> str:
    """Unit of the times in a file of poses.

    Args:
        stamps: float64 [n], as in the file.
        times: float64 [m], seconds at which images were taken; None: they tell no time.

    Returns:
        The unit in which the file covers most images; without their times, or if it covers none in any, the first in
        which poses follow one another within `StampTuning.max_step_s`.
    """
    stamps = stamps[np.isfinite(stamps)]
    if times is not None and len(stamps) and len(times):
        inside = {
            unit: np.mean((times >= stamps.min() * size - 0.1) & (times <= stamps.max() * size + 0.1))
            for unit, size in UNITS.items()
        }
        best = max(inside, key=lambda unit: inside[unit])
        if inside[best] > 0:
            return best
    steps = np.abs(np.diff(stamps))
    steps = steps[steps > 0]
    if not len(steps):
        return "s"
    return next((unit for unit, size in UNITS.items() if np.median(steps) * size < StampTuning.max_step_s), "ns")


def are_counted(stamps: np.ndarray) -> bool:
    """Whether stamps are no times but numbers of frames: whole, rising, and by one at a time mostly."""
    steps = np.diff(stamps)
    whole = bool(np.isfinite(stamps).all() and (stamps == np.round(stamps)).all())
    return whole and len(steps) > 1 and bool((steps > 0).all()) and float(np.median(steps)) == 1.0
