# SPDX-License-Identifier: Apache-2.0
"""Nodes meet by a router, as those of rmw_zenoh_cpp do, and by a configuration file of the user's."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from networks import free_port, wait_until

from ggslam.errors import MiddlewareError
from ggslam.middleware.node import LATCHED, NodeRequest, Qos, Received
from ggslam.middleware.zenoh_node import ZenohNode

zenoh = pytest.importorskip("zenoh")
pytest.importorskip("rosbags")
TEXT, TRIGGER = "std_msgs/msg/String", "std_srvs/srv/Trigger"
HELLO = b"\0\1\0\0\6\0\0\0hello\0"


def router(port: int) -> Any:
    """Configured as rmw_zenohd is."""
    config = zenoh.Config()
    for path, value in {
        "mode": "router", "listen/endpoints": [f"tcp/127.0.0.1:{port}"], "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
    }.items():  # fmt: skip
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def talk(one: ZenohNode, other: ZenohNode) -> None:
    """Messages, a latched one, and a service between two nodes."""
    got: list[Received] = []
    publisher = one.publisher("/chatter", TEXT, Qos())
    one.publisher("/map", TEXT, LATCHED).send(HELLO)
    other.subscribe("/chatter", TEXT, Qos(), got.append)
    other.subscribe("/map", TEXT, LATCHED, got.append)
    assert wait_until(lambda: publisher.subscribers == 1 and len(got) == 1), (publisher.subscribers, got)
    assert wait_until(lambda: bool(publisher.send(HELLO) or len(got) > 2))
    response = one.types.make(TRIGGER + "_Response", success=True, message="")
    one.offer("/trigger", TRIGGER, lambda _: response)
    assert other.call("/trigger", TRIGGER, one.types.make(TRIGGER + "_Request")) == response


def test_nodes_meet_by_a_router_whenever_it_comes() -> None:
    port = free_port()
    opened: Callable[[str], ZenohNode] = lambda name: ZenohNode(  # noqa: E731
        NodeRequest("zenoh", 3, "", f"tcp/127.0.0.1:{port}", "jazzy"), name
    )
    one = opened("one")
    session = router(port)
    other = opened("other")
    talk(one, other)
    session.close()
    one.close()
    other.close()


def test_a_configuration_file_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    common = 'scouting: {multicast: {enabled: false}}, timestamping: {enabled: true}, mode: "peer"'
    for name, ends in (("a", "listen"), ("b", "connect")):
        text = f'{{ {common}, {ends}: {{ endpoints: ["tcp/127.0.0.1:{port}"] }} }}'
        (tmp_path / f"{name}.json5").write_text(text)
    nodes = []
    for name in ("a", "b"):
        monkeypatch.setenv("ZENOH_SESSION_CONFIG_URI", str(tmp_path / f"{name}.json5"))
        nodes.append(ZenohNode(NodeRequest("zenoh", 3, "", "", "jazzy"), name))
    talk(*nodes)
    for node in nodes:
        node.close()
    monkeypatch.setenv("ZENOH_SESSION_CONFIG_URI", str(tmp_path / "none.json5"))
    with pytest.raises(MiddlewareError, match="none.json5"):
        ZenohNode(NodeRequest("zenoh", 3, "", "", "jazzy"), "c")
