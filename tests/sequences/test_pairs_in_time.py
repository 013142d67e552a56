# SPDX-License-Identifier: Apache-2.0
"""Measurements are paired by time: nearest first, each once, and none is left alone that has a free partner."""

from __future__ import annotations

import numpy as np

from ggslam.sequences.association import pair_times


def test_pairs_are_one_to_one_and_nearest() -> None:
    pairs = pair_times(np.array([0.0, 1.0, 1.01, 5.0]), np.array([1.009, 0.005, 0.995, 5.5]), 0.02)
    assert pairs.tolist() == [[0, 1], [1, 2], [2, 0]]
    assert pair_times(np.array([]), np.array([1.0]), 0.02).shape == (0, 2)


def test_bursts_keep_all_their_pairs() -> None:
    """Six images within 5 ms and six depths that come 10 ms later: looking at the nearest neighbours alone would pair
    two of them."""
    times = 100 + np.arange(6) * 0.001
    pairs = pair_times(times, times + 0.010, 0.02)
    assert sorted(pairs[:, 0]) == sorted(pairs[:, 1]) == list(range(6))
