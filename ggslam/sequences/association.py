# SPDX-License-Identifier: Apache-2.0
"""Pairing measurements by time, and poses between measured ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.poses import se3_exp, so3_log
from ggslam.system.plurals import plural
from ggslam.system.tuning import Tuning


class PairingTuning(Tuning):
    """How colour and depth are paired by time."""

    tolerance_s = 0.02
    """Largest time between colour and depth, in seconds, as in the tool of the TUM benchmark."""
    unpaired = 0.04
    """Share of the colour images that may lack depth without a warning: two clocks of 30 Hz drift past each other."""
    wide_tolerance_s = 0.08
    """Largest time in seconds if less than half of the images pair up within `tolerance_s`."""


def pair_times(first: np.ndarray, second: np.ndarray, tolerance: float) -> np.ndarray:
    """Pairs of times first[i], second[j] at most `tolerance` seconds apart, each used once, closest pairs first.

    Args:
        first, second: float64 [n], [m], in any order.

    Returns:
        int64 [pairs, 2], rows (i, j) sorted by i.
    """
    order = np.argsort(second, kind="stable")
    sorted_second = second[order]
    low = np.searchsorted(sorted_second, first - tolerance, "left")
    high = np.searchsorted(sorted_second, first + tolerance, "right")
    candidates = [
        (abs(first[i] - sorted_second[j]), i, int(order[j])) for i in range(len(first)) for j in range(low[i], high[i])
    ]
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in sorted(candidates):
        if i not in pairs and j not in taken:
            pairs[i] = j
            taken.add(j)
    return np.array(sorted(pairs.items()), np.int64).reshape(-1, 2)


def pair_images(
    place: Path, color: np.ndarray, depth: np.ndarray, names: tuple[str, str], few: float = PairingTuning.unpaired
) -> tuple[list[tuple[int, int]], list[str]]:
    """Pairs (i, j) of colour images and the depth images taken at about the same time, and warnings.

    Args:
        place: of the recording, for messages.
        color, depth: times float64 [n], [m], seconds.
        names: what lists the two, for messages.
        few: share of the colour images that may be left out without a warning.

    Raises:
        SequenceError: nothing pairs up.
    """
    pairs = pair_times(color, depth, PairingTuning.tolerance_s)
    if len(pairs) and 2 * len(pairs) >= min(len(color), len(depth)):
        return _as_list(pairs), _left_out(len(color), len(pairs), names, few)
    wide = pair_times(color, depth, PairingTuning.wide_tolerance_s)
    if not len(wide):
        gap = min((np.abs(depth - t).min() for t in color), default=np.inf) if len(depth) else np.inf
        raise SequenceError(
            f"{place}: no image of {names[0]} is within {PairingTuning.wide_tolerance_s} s of one in {names[1]} "
            f"(closest: {gap:.3f} s); colour spans {span(color)}, depth {span(depth)}"
        )
    warning = (
        f"only {len(pairs)} of {len(color)} colour images have depth within {PairingTuning.tolerance_s} s; "
        f"{len(wide)} paired within {PairingTuning.wide_tolerance_s} s instead"
    )
    return _as_list(wide), [warning]


def _as_list(pairs: np.ndarray) -> list[tuple[int, int]]:
    return [(int(i), int(j)) for i, j in pairs]


def _left_out(images: int, used: int, names: tuple[str, str], few: float) -> list[str]:
    """A warning if more than the share `few` of the colour images have no depth of their time."""
    count = images - used
    if count <= few * images:
        return []
    have, are = plural(count, "has", "have"), plural(count, "is", "are")
    return [
        f"{count} of {images} colour images ({names[0]}) {have} no depth image of the same time ({names[1]}) within "
        f"{PairingTuning.tolerance_s:g} s and {are} left out"
    ]


def span(times: np.ndarray) -> str:
    """First and last time, for messages."""
    return f"{times.min():.3f} to {times.max():.3f} s" if len(times) else "no time at all"


def poses_at(
    times: np.ndarray, pose_times: np.ndarray, poses: np.ndarray, largest_gap: float = 0.1, tolerance: float = 0.02
) -> np.ndarray:
    """Poses at given times: interpolated between two measurements at most `largest_gap` seconds apart, else
    the nearest one within `tolerance` seconds, else NaN.

    Args:
        times: float64 [n], seconds.
        pose_times: float64 [m], any order.
        poses: float64 [m, 4, 4]; rows of NaN are left out.

    Returns:
        float64 [n, 4, 4].
    """
    result = np.full((len(times), 4, 4), np.nan)
    usable = np.nonzero(np.isfinite(poses).all((1, 2)))[0]
    usable = usable[np.argsort(pose_times[usable], kind="stable")]
    if len(usable) == 0:
        return result
    stamps, known = pose_times[usable], poses[usable]
    for i, t in enumerate(times):
        after = int(np.searchsorted(stamps, t, "left"))
        before = after - 1
        if before >= 0 and after < len(stamps) and 0 < stamps[after] - stamps[before] <= largest_gap:
            share = (t - stamps[before]) / (stamps[after] - stamps[before])
            result[i] = _between(known[before], known[after], share)
            continue
        nearest = min((k for k in (before, after) if 0 <= k < len(stamps)), key=lambda k: abs(stamps[k] - t))
        if abs(stamps[nearest] - t) <= tolerance:
            result[i] = known[nearest]
    return result


def _between(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    """Pose at a share of the way: position on the straight line, rotation about one axis."""
    turn = so3_log(first[:3, :3].T @ second[:3, :3])
    result = np.eye(4)
    result[:3, :3] = first[:3, :3] @ se3_exp(np.concatenate([np.zeros(3), share * turn]))[:3, :3]
    result[:3, 3] = (1 - share) * first[:3, 3] + share * second[:3, 3]
    return result
