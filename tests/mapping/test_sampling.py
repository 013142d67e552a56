# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ggslam.mapping.sampling import KeyframeSampler


def test_every_keyframe_comes_up_equally_often() -> None:
    sampler = KeyframeSampler(np.random.default_rng(0))
    with pytest.raises(IndexError):
        sampler.draw()
    for _ in range(7):
        sampler.add()
    draws = [sampler.draw() for _ in range(7 * 20)]
    assert np.bincount(draws).tolist() == [20] * 7
    rounds = np.reshape(draws, (20, 7))
    assert all(sorted(r) == list(range(7)) for r in rounds) and len({tuple(r) for r in rounds}) >= 5


def test_a_new_keyframe_is_drawn_within_the_current_round() -> None:
    sampler = KeyframeSampler(np.random.default_rng(1))
    for _ in range(5):
        sampler.add()
    sampler.draw()
    sampler.add()
    assert 5 in [sampler.draw() for _ in range(5)]


def test_same_seed_same_order() -> None:
    orders = []
    for _ in range(2):
        sampler = KeyframeSampler(np.random.default_rng(3))
        for _ in range(4):
            sampler.add()
        orders.append([sampler.draw() for _ in range(12)])
    assert orders[0] == orders[1]
