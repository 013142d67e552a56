# SPDX-License-Identifier: Apache-2.0
"""Streams of colour and depth, paired as they come."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.sequences.association import pair_times
from ggslam.sequences.live_pairs import LivePairTuning, PairMatcher


def paired(matcher: PairMatcher[int], color: np.ndarray, depth: np.ndarray) -> list[tuple[int, int]]:
    """Pairs (i, j) of times, fed in the order of time; what waits at the end included."""
    sent = sorted([(t, "color", i) for i, t in enumerate(color)] + [(t, "depth", j) for j, t in enumerate(depth)])
    pairs = [pair for t, kind, n in sent for pair in matcher.add(kind, t, n)]  # type: ignore[arg-type]
    return [(c.content, d.content) for c, d in [*pairs, *matcher.settle()]]


def test_equal_times_pair_at_once() -> None:
    matcher: PairMatcher[str] = PairMatcher()
    for i in range(5):
        assert matcher.add("depth", i / 30, "d") == []
        assert [(c.content, d.content) for c, d in matcher.add("color", i / 30, "c")] == [("c", "d")]
    assert not matcher.unmatched.total()


@pytest.mark.parametrize("offset", [0.0, 0.004, 0.012, -0.012])
@pytest.mark.parametrize("seed", range(5))
def test_pairs_are_those_of_a_recording(offset: float, seed: int) -> None:
    """With jitter, and a tenth of the images missing."""
    rng = np.random.default_rng(seed)
    times = np.arange(200) / 30
    color, depth = (
        (times + shift + rng.uniform(-0.001, 0.001, 200))[rng.random(200) > 0.1] for shift in (0.0, offset)
    )
    matcher: PairMatcher[int] = PairMatcher()
    assert paired(matcher, color, depth) == [(int(i), int(j)) for i, j in pair_times(color, depth, 0.02)]
    left = len(color) + len(depth) - 2 * len(pair_times(color, depth, 0.02))
    assert matcher.unmatched.total() <= left <= matcher.unmatched.total() + 2  # the last ones still wait
    assert set(matcher.unmatched) == {"without a partner"}


def test_reasons() -> None:
    matcher: PairMatcher[int] = PairMatcher(0.01)
    for i in range(LivePairTuning.most_waiting + 3):
        assert matcher.add("color", i / 30, i) == []
    assert matcher.unmatched == {"no depth came": 3}
    matcher.add("color", 0.1, 0)
    matcher.add("color", (LivePairTuning.most_waiting + 2) / 30, 0)
    assert matcher.unmatched == {"no depth came": 3, "came out of order": 1, "came twice": 1}
    matcher.add("depth", 10.0, 0)
    assert matcher.unmatched["without a partner"] == LivePairTuning.most_waiting and matcher.closest_s > 9
    assert matcher.add("color", 10.0, 0) and not matcher.jumps
    matcher.add("color", 10.2, 0)
    matcher.add("depth", 2.0, 0)
    assert (matcher.jumps, matcher.went_back_s) == (1, 8.0) and matcher.unmatched["the clock went back"] == 1
    assert matcher.add("color", 2.0, 0)
