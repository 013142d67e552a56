# SPDX-License-Identifier: Apache-2.0
"""The WebSocket server of Foxglove's outlet, as a client sees it."""

from __future__ import annotations

import base64
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from message_samples import STAMP, sample_contents, sample_mesh, sample_points
from second_readers import cloud_table, read_protobuf
from websocket_client import FoxgloveClient

from ggslam.errors import MiddlewareError, MissingDependency
from ggslam.messages.contents import Channel, Mesh, Points, Pose
from ggslam.messages.foxglove_outlet import FoxgloveOutlet, FoxgloveTuning
from ggslam.messages.stamps import whole_nanoseconds
from ggslam.system.tuning import overridden

pytest.importorskip("foxglove")
pytest.importorskip("google.protobuf")

POINTS, LATCHED, MESH = Channel("points", Points), Channel("map", Points, True), Channel("mesh", Mesh, True)


@pytest.fixture
def outlet() -> Iterator[FoxgloveOutlet]:
    made = FoxgloveOutlet(port=0)
    for channel in (POINTS, LATCHED, MESH):
        made.open(channel)
    yield made
    made.close()


def wait_for(true: Callable[[], object]) -> None:
    deadline = time.monotonic() + 5
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def decoded(client: FoxgloveClient, topic: str, content: bytes) -> Any:
    channel = client.channels[topic]
    schema = SimpleNamespace(name=channel["schemaName"], data=base64.b64decode(channel["schema"]))
    return read_protobuf(schema, content)


def test_a_client_gets_what_is_sent(outlet: FoxgloveOutlet) -> None:
    client = FoxgloveClient(outlet.port)
    client.subscribe("/points")
    wait_for(lambda: outlet.listeners(POINTS))
    assert outlet.listeners(LATCHED) == 0
    content = sample_points(1000)
    size = outlet.send(POINTS, content, STAMP)
    topic, at, message = client.message()
    assert (topic, at, len(message)) == ("/points", whole_nanoseconds(STAMP), size)
    table = cloud_table(decoded(client, topic, message))
    assert np.array_equal(np.stack([table[n] for n in "xyz"], 1), content.xyz)
    client.close()
    wait_for(lambda: not outlet.listeners(POINTS))


def test_who_joins_late_gets_the_last_of_latched_channels(outlet: FoxgloveOutlet) -> None:
    told: list[Channel] = []
    outlet.on_join(told.append)
    for count in (3, 4):
        outlet.send(LATCHED, sample_points(count), STAMP)
        outlet.send(POINTS, sample_points(count), STAMP)
    outlet.send(MESH, sample_mesh(""), STAMP)
    outlet.send(MESH, sample_mesh("a"), STAMP)
    clients = []
    for number in (1, 2):
        client = FoxgloveClient(outlet.port)
        clients.append(client)
        client.subscribe("/map", "/mesh", "/points")
        found = dict(client.message()[::2] for _ in range(2))
        assert len(cloud_table(decoded(client, "/map", found["/map"]))) == 4
        assert [entity.id for entity in decoded(client, "/mesh", found["/mesh"]).entities] == ["mesh"]
        wait_for(lambda expected=number: outlet.listeners(POINTS) == expected)
    wait_for(lambda: len(told) == 6)
    assert set(told) == {LATCHED, MESH, POINTS}


def test_a_stalled_client_slows_nothing_and_holds_little(outlet: FoxgloveOutlet) -> None:
    stalled = FoxgloveClient(outlet.port, buffer_bytes=4096)
    stalled.subscribe("/points")
    wait_for(lambda: outlet.listeners(POINTS))
    content = sample_points(20_000)
    longest = 0.0
    for k in range(FoxgloveTuning.backlog * 3):
        start = time.thread_time()
        outlet.send(POINTS, content, float(k))
        longest = max(longest, time.thread_time() - start)
    assert longest < 0.5
    reader = FoxgloveClient(outlet.port)
    reader.subscribe("/points")
    wait_for(lambda: outlet.listeners(POINTS) == 2)
    outlet.send(POINTS, content, 1000.0)
    assert reader.message()[1] == 1000 * 10**9
    times = [stalled.message()[1] // 10**9]
    while times[-1] != 1000:
        times.append(stalled.message()[1] // 10**9)
    assert times == sorted(times)
    assert len(times) < FoxgloveTuning.backlog * 2, "the oldest are left out"


def test_clients_that_come_and_go_while_much_is_sent(outlet: FoxgloveOutlet) -> None:
    outlet.send(LATCHED, sample_points(10), STAMP)
    ended = threading.Event()

    def visit() -> None:
        while not ended.is_set():
            client = FoxgloveClient(outlet.port)
            client.subscribe("/map", "/points", "/mesh")
            client.message()
            client.close()

    visitors = [threading.Thread(target=visit) for _ in range(4)]
    for visitor in visitors:
        visitor.start()
    for k in range(300):
        outlet.send((LATCHED, POINTS)[k % 2], sample_points(10), float(k))
        time.sleep(0.002)
    ended.set()
    for visitor in visitors:
        visitor.join(10)
        assert not visitor.is_alive()


def test_a_port_that_is_taken_is_told(outlet: FoxgloveOutlet) -> None:
    with pytest.raises(MiddlewareError, match=f"cannot listen at 127.0.0.1:{outlet.port}"):
        FoxgloveOutlet(port=outlet.port)
    with pytest.raises(MiddlewareError, match="cannot listen at no.address"):
        FoxgloveOutlet("no.address.here.invalid", 0)
    assert str(outlet.port) in outlet.url()


def test_without_the_package_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(MissingDependency, match=r"pip install 'ggslam\[foxglove\]'"):
        FoxgloveOutlet(port=0)


def test_two_servers_of_a_process_do_not_mix(outlet: FoxgloveOutlet) -> None:
    with overridden(FoxgloveTuning, backlog=8):
        other = FoxgloveOutlet(port=0)
    for channel in sample_contents():
        other.open(channel)
    client = FoxgloveClient(other.port)
    client.subscribe("/pose")
    assert "/map" not in client.channels
    broken = np.full((4, 4), np.nan)
    assert other.send(Channel("pose", Pose), Pose("map", broken), STAMP) == 0
    assert (other.left_out(), outlet.left_out()) == (1, 0)
    other.close()
    other.close()
