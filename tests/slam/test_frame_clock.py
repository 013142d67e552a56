# SPDX-License-Identifier: Apache-2.0
"""The pace of real-time runs, by a clock that the tests turn."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest

from ggslam.slam.frame_clock import FrameClock

PERIOD = 0.1


@dataclass
class Stub:
    """What the clock looks at of a frame."""

    index: int
    timestamp: float


class Time:
    """Seconds that pass when somebody lets them."""

    def __init__(self) -> None:
        self.seconds = 5.0

    def now(self) -> float:
        return self.seconds

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0
        self.seconds += seconds


def camera(time: Time, when: list[float]) -> Iterator[Stub]:
    """A live camera whose frames are there at these times, and wait for whoever asks late."""
    begin = time.now()
    for index, due in enumerate(when):
        time.sleep(max(0.0, begin + due - time.now()))
        yield Stub(index, due)


def recording(time: Time, frames: int, read: Callable[[int], float]) -> Iterator[Stub]:
    for index in range(frames):
        time.sleep(read(index))
        yield Stub(index, index / 7)


def taken(
    clock: FrameClock, time: Time, frames: Iterator[Stub], work: Callable[[int], float]
) -> tuple[list[int], list[int]]:
    """Indices of frames that were taken and that were dropped, where a frame takes `work(index)` seconds."""
    kept, dropped = [], []
    for frame in clock.pace(frames, lambda late: dropped.append(late.index)):
        kept.append(frame.index)
        time.sleep(work(frame.index))
    return kept, dropped


def clock_of(time: Time, live: bool = False) -> FrameClock:
    return FrameClock(PERIOD, live, time.now, time.sleep)


@pytest.mark.parametrize("live", [False, True])
def test_a_camera_that_stalls_once_loses_nothing_afterwards(live: bool) -> None:
    time = Time()
    when = [k * PERIOD + (0.5 if k >= 20 else 0.0) for k in range(60)]  # those of the stall never come
    assert taken(clock_of(time, live), time, camera(time, when), lambda _: 0.03) == (list(range(60)), [])


@pytest.mark.parametrize(("live", "work"), [(False, 0.01), (False, 0.15), (True, 0.01), (True, 0.15), (True, 0.19)])
def test_a_source_slower_than_stated_loses_none(live: bool, work: float) -> None:
    time = Time()
    when = [2 * k * PERIOD for k in range(40)]
    assert taken(clock_of(time, live), time, camera(time, when), lambda _: work) == (list(range(40)), [])


@pytest.mark.parametrize("live", [False, True])
def test_what_came_while_the_caller_was_busy_is_dropped_and_nothing_else(live: bool) -> None:
    time = Time()
    when = [k * PERIOD for k in range(60)]
    kept, dropped = taken(clock_of(time, live), time, camera(time, when), lambda k: 1.05 if k == 20 else 0.03)
    assert dropped == list(range(21, 28))  # frame 28 came 0.3 s before: as late as a frame may be
    assert kept == [k for k in range(60) if k not in dropped]


def test_a_caller_that_is_always_too_slow_drops_its_share() -> None:
    time = Time()
    when = [k * PERIOD for k in range(200)]
    kept, dropped = taken(clock_of(time, live=True), time, camera(time, when), lambda _: 2 * PERIOD)
    assert len(kept) == pytest.approx(100, abs=4) and len(kept) + len(dropped) == 200


def test_a_recording_comes_at_the_stated_rate() -> None:
    time = Time()
    begin = time.now()
    kept, dropped = taken(clock_of(time), time, recording(time, 50, lambda _: 0.0), lambda _: 0.02)
    assert (len(kept), dropped) == (50, [])
    assert time.now() - begin == pytest.approx(49 * PERIOD + 0.04, abs=1e-6)


def test_frames_of_a_recording_are_dropped_while_reading_catches_up() -> None:
    """Reading takes a part of a period: that is no camera that lets wait."""
    time = Time()
    frames = recording(time, 60, lambda k: 0.0 if k < 25 else 0.02)
    kept, dropped = taken(clock_of(time), time, frames, lambda k: 1.05 if k == 20 else 0.03)
    assert dropped == list(range(21, 29)) and kept == [k for k in range(60) if k not in dropped]


def test_a_disk_that_stalls_loses_nothing() -> None:
    time = Time()
    frames = recording(time, 60, lambda k: 2.0 if k == 30 else 0.0)
    assert taken(clock_of(time), time, frames, lambda _: 0.03) == (list(range(60)), [])


def test_a_camera_without_a_clock_loses_none() -> None:
    time = Time()
    frames = (Stub(frame.index, 0.0) for frame in camera(time, [k * PERIOD for k in range(50)]))
    assert taken(clock_of(time, live=True), time, frames, lambda _: 0.03) == (list(range(50)), [])


def test_frames_that_come_in_a_burst_after_a_stall_are_caught_up_with() -> None:
    time = Time()
    burst = camera(time, [k * PERIOD if k < 20 or k >= 30 else 30 * PERIOD for k in range(60)])
    stamped = (Stub(frame.index, frame.index * PERIOD) for frame in burst)
    begin, lag = time.now(), []

    def work(index: int) -> float:
        lag.append(time.now() - begin - index * PERIOD)
        return 0.03

    kept, dropped = taken(clock_of(time, live=True), time, stamped, work)
    assert dropped == [] and max(lag) == pytest.approx(1.0) and lag[-1] == pytest.approx(0.0, abs=0.01)


def test_a_source_that_hands_out_the_newest_only_loses_none() -> None:
    time = Time()
    clock = clock_of(time, live=True)
    clock.drops = False
    assert taken(clock, time, camera(time, [0.1 * k for k in range(8)]), lambda index: 0.5) == (list(range(8)), [])
