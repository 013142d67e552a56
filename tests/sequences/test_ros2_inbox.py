# SPDX-License-Identifier: Apache-2.0
"""The inbox of live images: stamps that drivers leave out, and publishers that get in one another's way."""

from __future__ import annotations

import struct

from ggslam.middleware.node import Received
from ggslam.sequences.formats.ros2_inbox import PairInbox


def message(stamp: float, at: float, writer: str = "one") -> Received:
    seconds = int(stamp)
    head = struct.pack("<4BiI", 0, 1, 0, 0, seconds, round(1e9 * (stamp - seconds)))
    return Received(head + b"an image", at, writer)


def pair_of(inbox: PairInbox, stamp: float, at: float, writer: str = "one") -> None:
    for kind in ("color", "depth"):
        inbox.taker(kind)(message(stamp, at, writer))  # type: ignore[arg-type]


def test_no_image_keeps_a_time_of_zero_where_a_driver_leaves_it_out() -> None:
    inbox = PairInbox(("/color", "/depth"), 0.02)
    pair_of(inbox, 0.0, 1.7e9)
    first = inbox.take(0.5)
    assert first is not None
    pair_of(inbox, 0.0, 1.7e9 + 0.1)
    inbox.give_back(first)
    pair_of(inbox, 0.0, 1.7e9 + 0.2)
    found = inbox.take(0.5)
    assert found is not None and found.color.stamp > 1.7e9 and found.depth.stamp > 1.7e9
    again = PairInbox(("/color", "/depth"), 0.02)
    pair_of(again, 0.0, 1.7e9)
    first = again.take(0.5)
    assert first is not None
    again.taker("color")(message(0.0, 1.7e9 + 0.1))  # no newer pair yet, but it is known that zeros are no times
    again.give_back(first)
    found = again.take(0.5)
    assert found is not None and found.color.stamp == found.depth.stamp == 1.7e9


def test_a_recording_may_begin_at_zero() -> None:
    inbox = PairInbox(("/color", "/depth"), 0.02)
    pair_of(inbox, 0.0, 1.7e9)
    first = inbox.take(0.5)
    assert first is not None and first.color.stamp == 0.0
    pair_of(inbox, 0.1, 1.7e9 + 0.1)
    second = inbox.take(0.5)
    assert second is not None and second.color.stamp == 0.1 and not inbox.events()


def test_two_cameras_on_one_topic_are_told_once() -> None:
    inbox = PairInbox(("/color", "/depth"), 0.005)
    for number in range(10):
        pair_of(inbox, 5.0 + number / 10, 5.0, ("one", "other")[number % 2])
    said = [text for text in inbox.events() if "two publishers" in text]
    assert len(said) == 2 and "/color" in said[0] + said[1] and "/depth" in said[0] + said[1]
    alone = PairInbox(("/color", "/depth"), 0.005)
    for number in range(10):
        pair_of(alone, 5.0 + number / 10, 5.0)
    assert not alone.events()


def test_each_pair_is_counted_once() -> None:
    inbox = PairInbox(("/color", "/depth"), 0.02)
    for number in range(5):
        pair_of(inbox, 5.0 + number, 5.0 + number)
        if number == 1:
            assert inbox.take(0.5) is not None
    counts = inbox.counts()
    assert (counts["pairs"], counts["taken"], counts["overwritten"], counts["waiting"]) == (5, 1, 3, 1)
