# SPDX-License-Identifier: Apache-2.0
"""The nodes in memory that other tests use, and how messages are handed over."""

from __future__ import annotations

import threading
import time

import pytest
from local_node import LocalNetwork

from ggslam.errors import MiddlewareError
from ggslam.middleware.delivery import Delivery, Gaps
from ggslam.middleware.node import LATCHED, SENSOR_DATA, Qos, Received

TEXT = "std_msgs/msg/String"


def test_messages_come_in_order_and_numbered() -> None:
    network = LocalNetwork()
    a, b, got = network.node("a"), network.node("b", "robot"), []
    b.subscribe("chatter", TEXT, Qos(depth=100), got.append)
    publisher = a.publisher("/robot/chatter", TEXT, Qos())
    for i in range(100):
        publisher.send(bytes([i]))
    network.settle()
    assert [received.content[0] for received in got] == list(range(100))
    assert [received.number for received in got] == list(range(1, 101))
    assert publisher.subscribers == 1 and a.topics() == {"/robot/chatter": TEXT}
    b.close()
    assert publisher.subscribers == 0


def test_who_joins_late_gets_the_latched_message() -> None:
    network = LocalNetwork()
    publisher = network.node("a").publisher("/map", TEXT, LATCHED)
    publisher.send(b"old")
    publisher.send(b"new")
    got: list[Received] = []
    network.node("b").subscribe("/map", TEXT, LATCHED, got.append)
    network.node("c").subscribe("/map", TEXT, Qos(), got.append)  # volatile: only what comes from now on
    network.settle()
    assert [received.content for received in got] == [b"new"]
    network.node("d").publisher("/map", TEXT, SENSOR_DATA).send(b"x")  # offers less than is wanted
    network.settle()
    assert len(got) == 1


def test_services() -> None:
    network = LocalNetwork()
    a, b = network.node("a"), network.node("b")
    a.offer("/double", "x_msgs/srv/Double", lambda x: 2 * x)
    a.offer("/broken", "x_msgs/srv/Double", lambda x: 1 / 0)
    assert b.call("/double", "x_msgs/srv/Double", 4) == 8
    for name in ("/nobody", "/broken"):
        with pytest.raises(MiddlewareError, match=name):
            b.call(name, "x_msgs/srv/Double", 4, 0.2)
    a.close()
    with pytest.raises(MiddlewareError):
        b.call("/double", "x_msgs/srv/Double", 4, 0.2)


def test_a_slow_taker_gets_the_newest_and_holds_up_nobody() -> None:
    free, got = threading.Event(), []

    def take(received: Received) -> None:
        free.wait(5)
        got.append(received.number)

    delivery = Delivery("/x", 3, take)
    began = time.monotonic()
    for i in range(100):
        delivery.put(Received(b"", 0.0, "w", i))
        if not i:
            while delivery._waiting:
                time.sleep(0.001)
    assert time.monotonic() - began < 2
    free.set()
    assert delivery.wait_idle(5)
    assert got == [0, 97, 98, 99] and delivery.overrun == 96
    delivery.close()


def test_what_a_taker_raises_is_kept(caplog: pytest.LogCaptureFixture) -> None:
    def take(received: Received) -> None:
        if received.number != 1:
            raise ValueError(f"number {received.number}")

    delivery = Delivery("/x", 10, take)
    for i in range(4):
        delivery.put(Received(b"", 0.0, "w", i))
    assert delivery.wait_idle(5)
    assert delivery.failures == 3 and str(delivery.last_failure) == "number 3"
    assert len([r for r in caplog.records if "/x" in r.getMessage()]) == 1
    delivery.close()


def test_a_taker_may_close_its_own_subscription() -> None:
    network, seen = LocalNetwork(), threading.Event()
    made = []

    def take(_: Received) -> None:
        made[0].close()
        seen.set()

    made.append(network.node("a").subscribe("/x", TEXT, Qos(), take))
    publisher = network.node("b").publisher("/x", TEXT, Qos())
    publisher.send(b"1")
    assert seen.wait(5)
    publisher.send(b"2")


def test_gaps_are_counted_writer_by_writer() -> None:
    gaps = Gaps()
    assert all(gaps.note("a", n) for n in (5, 6, 9)) and gaps.lost == 2
    assert all(gaps.note("b", n) for n in (1, 2)) and gaps.lost == 2
    assert not gaps.note("a", 9) and not gaps.note("a", 7)
    gaps.note("a", 5000)
    lost = gaps.lost
    assert gaps.note("a", 1) and gaps.note("a", 2) and gaps.lost == lost, "the writer began again"
    assert gaps.note("c", None)
