# SPDX-License-Identifier: Apache-2.0
"""Groups images of a rig's cameras by time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ggslam.sequences.association import pair_times


def find_instants(times: Sequence[np.ndarray], tolerance: float) -> np.ndarray:
    """Instants of a rig: images of different cameras that were taken at most `tolerance` seconds apart, the nearest
    together; an image without a partner is an instant of its own.

    Args:
        times: of each camera's frames, float64 [n_c], seconds.
        tolerance: seconds.

    Returns:
        Number of each camera's frame at each instant, int64 [instants, cameras], -1 where it has none, by time.
    """
    rows = np.full((len(times[0]), len(times)), -1)
    rows[:, 0] = np.arange(len(times[0]))
    at = np.array(times[0], float)
    for number, own in enumerate(times[1:], start=1):
        pairs = pair_times(at, own, tolerance)
        rows[pairs[:, 0], number] = pairs[:, 1]
        alone = np.setdiff1d(np.arange(len(own)), pairs[:, 1])
        more = np.full((len(alone), len(times)), -1)
        more[:, number] = alone
        rows, at = np.concatenate([rows, more]), np.concatenate([at, own[alone]])
    return rows[np.argsort(at, kind="stable")]


def gaps(times: Sequence[np.ndarray], instants: np.ndarray) -> np.ndarray:
    """Seconds by which each camera's frames are after those of the first camera that took one at the same instant,
    float64 [instants, cameras], NaN where it has none."""
    taken = np.full(instants.shape, np.nan)
    for number, own in enumerate(times):
        there = instants[:, number] >= 0
        taken[there, number] = own[instants[there, number]]
    first = np.argmax(instants >= 0, axis=1)
    return taken - taken[np.arange(len(taken)), first][:, None]
