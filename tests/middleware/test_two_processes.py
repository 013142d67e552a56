# SPDX-License-Identifier: Apache-2.0
"""Two processes talk over Zenoh and over DDS."""

from __future__ import annotations

import time

import pytest
from networks import Network, end, image, wait_until
from peer import IMAGE, PAIRS, TEXT, TRIGGER, register

from ggslam.errors import MiddlewareError
from ggslam.middleware.node import LATCHED, Qos, Received
from ggslam.middleware.types import message_types


def test_images_go_and_come_back(network: Network) -> None:
    node, got = network.node(), []
    peer = network.peer()
    node.subscribe("/pong", IMAGE, Qos(depth=50), got.append)
    ping = node.publisher("/ping", IMAGE, Qos(depth=50))
    assert wait_until(lambda: ping.subscribers == 1 and node.topics().get("/pong") == IMAGE)
    wait_until(lambda: False, 0.3)  # the way back is found on the other side
    sent = [image(number) for number in range(20)]
    for content in sent:
        ping.send(content)
        time.sleep(0.03)
    assert wait_until(lambda: len(got) == 20), len(got)
    assert [received.content for received in got] == sent, "in order, byte for byte"
    assert len({received.writer for received in got}) == 1 and abs(got[-1].at - time.time()) < 10
    assert node.topics() == {"/ping": IMAGE, "/pong": IMAGE, "/latched": TEXT}
    assert end(peer) == "closed\n"
    assert wait_until(lambda: ping.subscribers == 0)
    node.close()


def test_who_joins_late_gets_the_last_latched_message(network: Network) -> None:
    node = network.node()
    peer = network.peer()
    late: list[Received] = []
    volatile: list[Received] = []
    node.subscribe("/latched", TEXT, Qos(depth=1), volatile.append)
    subscription = node.subscribe("/latched", TEXT, LATCHED, late.append)
    assert wait_until(lambda: bool(late))
    assert not wait_until(lambda: len(late) > 1 or bool(volatile), 0.3)
    assert message_types("jazzy").decode(TEXT, late[0].content).data == f"from {peer.pid}"
    assert subscription.lost == 0
    end(peer)
    node.close()


def test_services(network: Network) -> None:
    register()
    node, types = network.node(), message_types("jazzy")
    peer = network.peer()
    empty = types.make(TRIGGER + "_Request")
    for _ in range(3):
        response = node.call("/trigger", TRIGGER, empty, 8.0)
        assert response.success and response.message == f"by {peer.pid}"
    points = [types.make("geometry_msgs/msg/Point", x=float(i), y=1.0, z=0.0) for i in range(5)]
    response = node.call("/pairs", PAIRS, types.make(PAIRS + "_Request", points=points))
    assert response.lengths.tolist() == [1, 2, 3, 4, 5]
    for name in ("/nobody", "/broken"):
        began = time.monotonic()
        with pytest.raises(MiddlewareError, match=name):
            node.call(name, TRIGGER, empty, 0.5)
        assert time.monotonic() - began < 3
    assert node.call("/trigger", TRIGGER, empty).success
    end(peer)
    node.close()


@pytest.mark.parametrize("listens", [True, False])
def test_a_peer_that_was_killed_is_found_again(network: Network, listens: bool) -> None:
    """Of Zenoh, whichever of the two connects to the other."""
    node, got = network.node(listens=listens), []
    node.subscribe("/latched", TEXT, LATCHED, got.append)

    def heard(process: int) -> bool:  # who listens already may get both messages of the peer
        decode = message_types("jazzy").decode
        return any(decode(TEXT, received.content).data == f"from {process}" for received in got)

    peer = network.peer(not listens)
    assert wait_until(lambda: heard(peer.pid))
    peer.kill()
    peer.wait(5)
    second = network.peer(not listens)
    assert wait_until(lambda: heard(second.pid))
    assert node.call("/trigger", TRIGGER, message_types("jazzy").make(TRIGGER + "_Request"), 8.0).success
    end(second)
    node.close()


def test_a_request_is_answered_once(network: Network) -> None:
    """A client that gets no answer does not ask again: the request may have done something."""
    node, types, calls = network.node(), message_types("jazzy"), []
    node.offer("/broken", TRIGGER, lambda request: calls.append(request))  # None is no response
    with pytest.raises(MiddlewareError, match="/broken"):
        node.call("/broken", TRIGGER, types.make(TRIGGER + "_Request"), 1.0)
    assert len(calls) == 1
    node.close()
