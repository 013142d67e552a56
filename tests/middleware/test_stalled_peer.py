# SPDX-License-Identifier: Apache-2.0
"""Somebody who stands still slows nobody, and leaving the network is clean whatever happened."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

from networks import Network, end, image, wait_until
from peer import IMAGE, TEXT

from ggslam.middleware.node import Qos, Received

FRAMES, PERIOD_S = 40, 0.02
LEAVE = """
import sys
from ggslam.middleware.node import Qos, LATCHED
from ggslam.middleware.opening import NodeRequest, open_node
node = open_node(NodeRequest(sys.argv[1], int(sys.argv[3]), "", sys.argv[2], "jazzy"), "leaver")
node.subscribe("/x", "std_msgs/msg/String", Qos(), print)
node.publisher("/x", "std_msgs/msg/String", LATCHED).send(bytes([0, 1, 0, 0, 2, 0, 0, 0, 65, 0]))
node.offer("/s", "std_srvs/srv/Trigger", print)
if sys.argv[4] == "raises":
    raise SystemExit(3)
"""


def test_a_subscriber_that_stands_still_slows_nothing(network: Network) -> None:
    node, got = network.node(), []
    peer = network.peer()
    ping = node.publisher("/ping", "sensor_msgs/msg/Image", Qos(depth=5))
    node.subscribe("/ping", IMAGE, Qos(depth=FRAMES), got.append)  # another one, who is quick
    assert wait_until(lambda: ping.subscribers == 2)
    content = image(1, 400, 500)
    times: list[float] = []
    peer.send_signal(signal.SIGSTOP)
    for _ in range(FRAMES):
        began = time.monotonic()
        ping.send(content)
        times.append(time.monotonic() - began)
        time.sleep(PERIOD_S)
    assert wait_until(lambda: len(got) == FRAMES), f"{len(got)} of {FRAMES} came to the quick one"
    assert sorted(times)[FRAMES // 2] < 0.02 and sum(times) < 0.6, [round(t, 4) for t in times]
    peer.send_signal(signal.SIGCONT)
    assert wait_until(lambda: ping.subscribers == 2)
    end(peer)
    node.close()


def test_nodes_leave_cleanly_even_if_nobody_closes_them(network: Network) -> None:
    for how, code in (("ends", 0), ("raises", 3)):
        command = [sys.executable, "-c", LEAVE, network.middleware, network.address(True), str(network.domain), how]
        done = subprocess.run(command, capture_output=True, text=True, timeout=10)
        assert done.returncode == code and "rror" not in done.stderr, done.stderr


def test_closing_twice_and_taking_after_a_raise(network: Network) -> None:
    node, got = network.node(), []

    def take(received: Received) -> None:
        got.append(received)
        if len(got) == 1:
            raise ValueError("the first")

    subscription = node.subscribe("/x", TEXT, Qos(), take)
    publisher = node.publisher("x", TEXT, Qos())
    assert wait_until(lambda: publisher.subscribers == 1)
    for _ in range(3):
        publisher.send(b"\0\1\0\0\2\0\0\0A\0\0\0")
    assert wait_until(lambda: len(got) == 3) and subscription.failures == 1
    subscription.close()
    publisher.send(b"\0\1\0\0\2\0\0\0A\0\0\0")
    subscription.close()
    node.close()
    node.close()
    assert len(got) == 3
