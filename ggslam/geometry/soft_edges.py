# SPDX-License-Identifier: Apache-2.0
"""Finds depth between a thing and its background, which cameras that smooth their images produce.

At an outline the depth of most cameras jumps from one pixel to the next. Phones and headsets smooth it or make it
larger: it becomes a slope, on which nothing is. A surface seen at a grazing angle slopes as well, but goes on on both
sides; inverse depth, which is linear on planes, tells the two apart.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from ggslam.system.tuning import Tuning


class SoftEdgeTuning(Tuning):
    """Depth between two surfaces."""

    min_outline_change = 0.2
    """Smallest relative change of inverse depth across an outline that tells how sharp outlines are."""
    min_slope_change = 0.04
    """Smallest relative change of inverse depth across a slope."""
    min_distance = 0.15
    """Smallest distance of a slope's inverse depth from either end, as a share of the change."""
    max_change_beyond = 0.3
    """Largest change of inverse depth beyond either end, as a share of the change. On a plane it is a half."""


def soft_edges(depth: np.ndarray, reach: int) -> np.ndarray:
    """Pixels between two surfaces, bool [H, W].

    Args:
        depth: float32 [H, W], metres, 0 where unknown.
        reach: half the width of a slope, pixels.
    """
    known = depth > 0
    inverse = np.where(known, 1 / np.maximum(depth, 1e-6), 0).astype(np.float32)
    return known & (_slopes(inverse, reach) | _slopes(inverse.T, reach).T)


def edge_sharpness(depth: np.ndarray, reach: int) -> tuple[float, int]:
    """How sharp outlines are: of the change across each the share that lies between two neighbouring pixels.

    Args:
        depth: float32 [H, W], metres, 0 where unknown.
        reach: half the width of a slope, pixels.

    Returns:
        The median, 1 if there are none; and the number of pixels that told it.
    """
    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0).astype(np.float32)
    shares = np.concatenate([_sharpness(inverse, reach), _sharpness(np.ascontiguousarray(inverse.T), reach)])
    return (float(np.median(shares)) if len(shares) else 1.0), len(shares)


def _sharpness(inverse: np.ndarray, reach: int) -> np.ndarray:
    """Of each row's pixel [n] in the middle of a strong change from row to row the largest step's share of it."""
    if len(inverse) <= 2 * reach:
        return np.zeros(0, np.float32)
    inside = slice(reach, len(inverse) - reach)
    change = np.abs(inverse[2 * reach :] - inverse[: -2 * reach])
    strong = (change > SoftEdgeTuning.min_outline_change * inverse[inside]) & (
        minimum_filter1d(inverse, 2 * reach + 1, 0)[inside] > 0
    )
    steps = np.abs(np.diff(inverse, axis=0, append=inverse[-1:]))  # from each row to the next
    largest = maximum_filter1d(steps, 2 * reach, 0)[inside]
    return (largest[strong] / change[strong]).clip(0, 1)


def _slopes(inverse: np.ndarray, reach: int) -> np.ndarray:
    """Where inverse depth [H, W] slopes between two surfaces from row to row; unknown (0) is none."""
    far = 2 * reach
    padded = np.pad(inverse, ((far, far), (0, 0)))
    before_far, before, here, after, after_far = (
        padded[far + k : far + k + len(inverse)] for k in (-far, -reach, 0, reach, far)
    )
    step = np.abs(after - before)
    between = np.minimum(np.abs(here - before), np.abs(here - after)) > SoftEdgeTuning.min_distance * step
    inside = (here - before) * (after - here) > 0
    beyond = (
        np.maximum(np.abs(before - before_far), np.abs(after - after_far)) < SoftEdgeTuning.max_change_beyond * step
    )
    seen = np.minimum(np.minimum(before_far, before), np.minimum(after, after_far)) > 0
    return seen & inside & between & beyond & (step > SoftEdgeTuning.min_slope_change * here)
