# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ggslam.mapping.sampling import KeyframeSampler, last_visits


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


def test_last_visits_are_one_a_round_and_one_more_for_what_a_keyframe_shows_alone() -> None:
    objects = {k: np.array([1, 2 + k % 2]) for k in range(6)}
    objects[4], objects[7] = np.array([1, 9]), np.zeros(0, int)
    visits = list(last_visits(objects, 6, 4))
    assert visits[0] == (4, 4)
    rounds = visits[1:7], visits[7:]
    assert [{steps for _, steps in one} for one in rounds] == [{4}, {2}]
    assert all(sorted(number for number, _ in one) == [0, 1, 2, 3, 4, 5] for one in rounds)
    assert [number for number, _ in visits[1:7]] != [0, 1, 2, 3, 4, 5]


def test_without_objects_or_steps_there_are_no_last_visits() -> None:
    assert not list(last_visits({}, 4, 4)) and not list(last_visits({3: np.zeros(0, int)}, 4, 4))
    assert not list(last_visits({3: np.array([5])}, 0, 4))
    assert list(last_visits({3: np.array([5])}, 1, 4)) == [(3, 1), (3, 1)]
