# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ggslam.mapping.sampling import KeyframeSampler


@pytest.mark.parametrize("count", [1, 2, 7, 40, 233])
def test_every_keyframe_comes_up_equally_often_and_never_waits_long(count: int) -> None:
    sampler = KeyframeSampler(0.3)
    draws = np.array([sampler.draw(count) for _ in range(count * 20)])
    visits = np.bincount(draws, minlength=count)
    assert visits.min() >= 18 and visits.max() <= 22
    longest_wait = max(np.diff(np.flatnonzero(draws == k)).max() for k in range(count))
    assert longest_wait <= 3 * count


def test_successive_draws_are_far_apart() -> None:
    sampler = KeyframeSampler()
    draws = [sampler.draw(100) for _ in range(500)]
    assert np.abs(np.diff(draws)).min() >= 35


def test_no_keyframe() -> None:
    with pytest.raises(IndexError):
        KeyframeSampler().draw(0)
