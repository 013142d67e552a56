# SPDX-License-Identifier: Apache-2.0
"""Publishing never waits, keeps to its budget, and tells who joins everything."""

from __future__ import annotations

import time

import numpy as np
import pytest
from serve_tools import KeptOutlet, SlowOutlet, until

from ggslam.errors import MiddlewareError
from ggslam.jobs.serve import channels as c
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.sending import SendTuning
from ggslam.messages.contents import Channel, Content, Points, Pose
from ggslam.system.tuning import overridden

CHANNELS = (c.POSE, c.POINTS, c.POINT_TILES)


def points(value: float) -> Points:
    return Points(c.MAP, np.full((1, 3), value, np.float32))


def pose(x: float) -> Pose:
    T = np.eye(4)
    T[0, 3] = x
    return Pose(c.MAP, T)


def test_the_newest_wins_and_nobody_waits() -> None:
    slow, quick = SlowOutlet(0.3), KeptOutlet()
    publisher = MapPublisher([(slow, False), (quick, False)], CHANNELS)
    began = time.monotonic()
    for k in range(20):
        publisher.put(c.POINTS, points(k), float(k))
        until(lambda: slow.begun)
        time.sleep(0.005)  # the quick one gets its turn
    assert time.monotonic() - began < 1.0
    assert publisher.wait_idle(5.0)
    assert [float(p.xyz[0, 0]) for p in slow.of(c.POINTS.name)] == [0, 19]
    assert len(quick.of(c.POINTS.name)) > 5
    assert publisher.senders[0].counts[c.POINTS.name].left_out == 18
    publisher.close()
    assert slow.closed and quick.closed


def test_poses_wait_their_turn_in_order() -> None:
    slow = SlowOutlet(0.005)
    publisher = MapPublisher([(slow, False)], CHANNELS)
    for k in range(30):
        publisher.put(c.POSE, pose(k), float(k))
    assert publisher.wait_idle(5.0)
    assert [kept.stamp for kept in slow.sent] == list(range(30))
    for k in range(200):
        publisher.put(c.POSE, pose(k), float(k))
    publisher.wait_idle(5.0)
    assert publisher.senders[0].counts[c.POSE.name].left_out >= 200 - SendTuning.waiting - 10
    assert slow.sent[-1].stamp == 199
    publisher.close()


def test_a_budget_bounds_the_bytes_and_a_file_has_none() -> None:
    outlet, file = KeptOutlet(size=100_000), KeptOutlet(size=100_000)
    with overridden(SendTuning, map_bytes_per_s=1_000_000, burst_s=0.1):
        publisher = MapPublisher([(outlet, False), (file, True)], CHANNELS)
        began = time.monotonic()
        for k in range(40):
            publisher.put(c.POINT_TILES, points(k), 0.0, part=str(k))
        until(lambda: len(file.sent) == 40)
        until(lambda: len(outlet.sent) >= 6)
        publisher.put(c.POSE, pose(1), 1.0)
        until(lambda: outlet.of(c.POSE.name), 0.5)  # a pose waits for no map
        time.sleep(max(0.0, 1.0 - (time.monotonic() - began)))
        sent, seconds = 100_000 * len(outlet.of(c.POINT_TILES.name)), time.monotonic() - began
    assert sent <= 1_000_000 * (seconds + 0.1) + 100_000
    publisher.close()


def test_who_joins_gets_all_parts() -> None:
    outlet = KeptOutlet(everybody=0)
    publisher = MapPublisher([(outlet, False)], CHANNELS)
    assert not publisher.is_wanted(c.POINT_TILES)
    for k in range(3):
        publisher.put(c.POINT_TILES, points(k), 0.0, part=str(k))
    publisher.put(c.POINT_TILES, points(9), 1.0, part="1")
    publisher.forget(c.POINT_TILES, "2")
    assert publisher.wait_idle(1.0) and not outlet.sent
    outlet.join(c.POINT_TILES.name)
    assert publisher.is_wanted(c.POINT_TILES)
    assert publisher.wait_idle(1.0)
    assert sorted(float(p.xyz[0, 0]) for p in outlet.of(c.POINT_TILES.name)) == [0, 9]
    publisher.close()


def test_what_was_sent_as_a_whole_is_not_sent_again() -> None:
    outlet = KeptOutlet()
    publisher = MapPublisher([(outlet, False)], CHANNELS)
    publisher.put(c.POINTS, points(1), 0.0)
    publisher.wait_idle(1.0)
    outlet.join(c.POINTS.name)  # the outlet keeps what is latched itself
    publisher.wait_idle(1.0)
    assert len(outlet.sent) == 1
    publisher.close()


class _Broken(KeptOutlet):
    def send(self, channel: Channel, content: Content, stamp: float) -> int:
        raise MiddlewareError("the network is gone")


def test_an_outlet_that_fails_is_told_once_and_stops_nobody(caplog: pytest.LogCaptureFixture) -> None:
    broken, well = _Broken(), KeptOutlet()
    publisher = MapPublisher([(broken, False), (well, False)], CHANNELS)
    for k in range(3):
        publisher.put(c.POSE, pose(k), float(k))
    assert publisher.wait_idle(1.0)
    assert len(well.sent) == 3 and len(caplog.records) == 1
    assert "the network is gone" in publisher.line() and "3 messages" in publisher.line()
    publisher.close()


def test_a_stalled_outlet_does_not_hold_up_the_end() -> None:
    publisher = MapPublisher([(SlowOutlet(30.0), False)], CHANNELS)
    publisher.put(c.POINTS, points(1), 0.0)
    began = time.monotonic()
    assert not publisher.wait_idle(0.1)
    with overridden(SendTuning, end_s=0.2):
        publisher.close()
    assert time.monotonic() - began < 2.0
