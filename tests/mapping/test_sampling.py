# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ggslam.mapping.covisibility import covisible
from ggslam.mapping.keyframe import Keyframe, make_keyframe
from ggslam.mapping.sampling import (
    CovisibleSampler,
    KeyframeSampler,
    NewestSampler,
    RandomSampler,
    SamplingTuning,
    last_visits,
    make_sampler,
)
from ggslam.mapping.settings import SamplingOrder
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import se3_exp
from ggslam.system.tuning import overridden


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


@pytest.mark.parametrize("order", ["spread", "random", "newest", "covisible"])
def test_no_keyframe(order: SamplingOrder) -> None:
    with pytest.raises(IndexError):
        make_sampler(order, 0).draw(0)


@pytest.mark.parametrize("order", ["spread", "random", "newest", "covisible"])
def test_draws_at_once_are_those_one_after_the_other(order: SamplingOrder) -> None:
    together, single = make_sampler(order, 3), make_sampler(order, 3)
    for count, times in ((1, 2), (7, 4), (40, 5), (40, 0), (41, 9)):
        numbers = range(2, 2 + 3 * count, 3)
        assert together.choose_many(numbers, times) == [single.choose(numbers) for _ in range(times)]
    assert together.choose(range(9)) == single.choose(range(9))


def test_the_default_order_is_that_of_its_formula() -> None:
    sampler, offset = make_sampler("spread", 5), np.random.default_rng(5).random()
    expected = [3 + 2 * int((offset + t * 0.6180339887498949) % 1 * 9) for t in range(1, 50)]
    assert [sampler.choose(range(3, 21, 2)) for _ in range(49)] == expected


def test_random_draws_are_uniform_and_repeat() -> None:
    draws, again = ([s.draw(10) for _ in range(4000)] for s in (RandomSampler(3), RandomSampler(3)))
    assert draws == again and draws != [RandomSampler(4).draw(10) for _ in range(4000)]
    visits = np.bincount(draws)
    assert np.abs(visits - 400).max() < 100  # 5 sigma
    assert abs(np.corrcoef(draws[1:], draws[:-1])[0, 1]) < 0.06


def test_newest_first_starts_over_when_a_keyframe_arrives() -> None:
    sampler = NewestSampler()
    assert [sampler.draw(3) for _ in range(4)] == [2, 1, 0, 2]
    assert [sampler.draw(5) for _ in range(3)] == [4, 3, 2]
    assert [sampler.draw(2) for _ in range(3)] == [1, 0, 1]


def wall_keyframes(turns: list[float]) -> list[Keyframe]:
    """A camera in the middle of a round room of radius 2 m, turned about the vertical by some degrees."""
    camera = Camera(96, 72, 80.0, 80.0, 47.5, 35.5)
    depth = (2 / np.hypot(1, camera.rays()[..., 0])).astype(np.float32)
    frame = Frame(0, 0, 0.0, np.zeros((72, 96, 3), np.uint8), depth, camera)
    return [
        make_keyframe(k, frame, se3_exp(np.array([0, 0, 0, 0, np.deg2rad(turn), 0]))) for k, turn in enumerate(turns)
    ]


def test_covisible_keyframes_show_the_same_surface() -> None:
    """The image is 62 degrees wide: of 40 degrees beside it shows a third, of 55 a tenth."""
    keyframes = wall_keyframes([180, 0, 90, 30, -55, -40, 10])
    assert covisible(keyframes[1], [k for k in keyframes if k.index != 1]) == [3, 5, 6]
    many = wall_keyframes([0, *range(1, 30)])
    assert covisible(many[0], many[1:]) == list(range(1, 9))


def test_covisible_keyframes_are_drawn_most_and_none_is_forgotten() -> None:
    keyframes = wall_keyframes([90, 100, 180, 200, 0, 10])
    sampler = CovisibleSampler(0)
    sampler.arrive(keyframes)
    visits = np.bincount([sampler.choose(range(6)) for _ in range(3000)], minlength=6) / 3000
    assert visits[4:].sum() == pytest.approx(0.8 + 0.2 / 3, abs=0.03) and visits[:4].min() > 0.02
    with overridden(SamplingTuning, elsewhere=0.0):
        assert {sampler.choose([0, 2, 4]) for _ in range(20)} == {4}  # others are on disk
        assert len({sampler.choose([0, 2]) for _ in range(40)}) == 2
        sampler.end()
        assert len({sampler.choose(range(6)) for _ in range(100)}) == 6


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
