# SPDX-License-Identifier: Apache-2.0
"""What goes over Zenoh, seen by plain Zenoh that does as rmw_zenoh_cpp does."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from typing import Any

import pytest
from networks import Network, free_port, wait_until

from ggslam.errors import MiddlewareError
from ggslam.middleware.node import LATCHED, SENSOR_DATA, NodeRequest, Qos, Received
from ggslam.middleware.types import message_types
from ggslam.middleware.zenoh_keys import attachment, gid_of, read_attachment
from ggslam.middleware.zenoh_node import ZenohNode

zenoh = pytest.importorskip("zenoh")
pytest.importorskip("rosbags")
TEXT, TRIGGER = "std_msgs/msg/String", "std_srvs/srv/Trigger"
TEXT_KEY = "std_msgs::msg::dds_::String_"
HELLO = b"\0\1\0\0\6\0\0\0hello\0"
EMPTY_REQUEST = b"\0\1\0\0\0"


@pytest.fixture
def pair() -> Iterator[tuple[ZenohNode, Any]]:
    """A node, and a plain session that is connected to it."""
    network = Network("zenoh", free_port(), 7)
    node = ZenohNode(NodeRequest("zenoh", 7, "", network.address(True), "jazzy"), "own")
    config = zenoh.Config()
    for path, value in {
        "mode": "peer", "connect/endpoints": [network.address(False)], "listen/endpoints": [],
        "scouting/multicast/enabled": False, "timestamping/enabled": True,
    }.items():  # fmt: skip
        config.insert_json5(path, json.dumps(value))
    session = zenoh.open(config)
    yield node, session
    session.close()
    node.close()


def test_what_a_publisher_sends(pair: tuple[ZenohNode, Any]) -> None:
    node, session = pair
    type_hash = message_types("jazzy").hash(TEXT)
    got: list[Any] = []
    session.declare_subscriber(f"7/chatter/{TEXT_KEY}/{type_hash}", got.append)
    publisher = node.publisher("/chatter", TEXT, Qos())
    assert wait_until(lambda: publisher.subscribers == 1), "somebody without a token listens"
    for _ in range(2):
        publisher.send(HELLO)
    assert wait_until(lambda: len(got) == 2)
    assert got[0].payload.to_bytes() == HELLO
    read = [read_attachment(sample.attachment.to_bytes()) for sample in got]
    assert [r[0] for r in read if r] == [1, 2] and read[0][2] == read[1][2]  # type: ignore[index]
    assert abs(read[0][1] - time.time_ns()) < 10e9  # type: ignore[index]


def test_tokens_show_what_a_node_has(pair: tuple[ZenohNode, Any]) -> None:
    node, session = pair
    node.publisher("/chatter", TEXT, SENSOR_DATA)
    subscription = node.subscribe("/map", TEXT, LATCHED, print)
    node.offer("/trigger", TRIGGER, print)
    type_hash, service_hash = (node.types.hash(kind) for kind in (TEXT, TRIGGER))

    def tokens() -> set[str]:
        replies = session.liveliness().get("@ros2_lv/7/**", timeout=2)
        return {"/".join(str(r.ok.key_expr).split("/")[5:]) for r in replies if r.ok}

    wanted = {
        "NN/%/%/own",
        f"MP/%/%/own/%chatter/{TEXT_KEY}/{type_hash}/2::,5:,:,:,,",
        f"MS/%/%/own/%map/{TEXT_KEY}/{type_hash}/:1:,1:,:,:,,",
        f"SS/%/%/own/%trigger/std_srvs::srv::dds_::Trigger_/{service_hash}/::,10:,:,:,,",
    }
    assert wait_until(lambda: tokens() == wanted), tokens()
    subscription.close()
    assert wait_until(lambda: not any(token.startswith("MS") for token in tokens()))


def test_publishers_of_another_distribution_are_heard(pair: tuple[ZenohNode, Any]) -> None:
    """Humble's types have no hash, and others may have another."""
    node, session = pair
    got: list[Received] = []
    subscription = node.subscribe("/chatter", TEXT, Qos(depth=100), got.append)
    publishers = [session.declare_publisher(f"7/chatter/{TEXT_KEY}/{h}") for h in ("TypeHashNotSupported", "RIHS01_0")]
    assert wait_until(lambda: all(p.matching_status.matching for p in publishers))
    gids = [gid_of("one"), gid_of("two")]
    for number in (1, 2, 5, 5):  # 3 and 4 are lost, and 5 comes twice
        for publisher, gid in zip(publishers, gids, strict=True):
            publisher.put(HELLO, attachment=attachment(number, 0, gid))
    publishers[0].put(HELLO)  # of somebody who attaches nothing
    publishers[0].put(HELLO, attachment=b"\1\2")
    assert wait_until(lambda: len(got) == 8)
    assert subscription.lost == 4 and {received.writer for received in got} == {gids[0].hex(), gids[1].hex(), ""}
    assert sorted(r.number for r in got if r.number is not None) == [1, 1, 2, 2, 5, 5]


def test_a_topic_of_others_is_seen(pair: tuple[ZenohNode, Any]) -> None:
    node, session = pair
    place = "@ros2_lv/7/aac3178e146ba6f1fc6e6a4085e77f21/0/10"
    good = session.liveliness().declare_token(f"{place}/MP/%/%/talker/%chatter/{TEXT_KEY}/RIHS01_0/::,7:,:,:,,")
    session.liveliness().declare_token(f"{place}/nonsense")
    assert wait_until(lambda: node.topics() == {"/chatter": TEXT})
    good.undeclare()
    assert wait_until(lambda: node.topics() == {})


def test_a_client_of_rmw_zenoh_is_answered(pair: tuple[ZenohNode, Any]) -> None:
    node, session = pair
    response = node.types.make(TRIGGER + "_Response", success=True, message="yes")
    node.offer("/trigger", TRIGGER, lambda _: response)
    gid = gid_of("client")
    for type_hash in (node.types.hash(TRIGGER), "TypeHashNotSupported"):
        where = f"7/trigger/std_srvs::srv::dds_::Trigger_/{type_hash}"
        querier = session.declare_querier(
            where, target=zenoh.QueryTarget.ALL_COMPLETE, consolidation=zenoh.ConsolidationMode.NONE, timeout=5
        )
        assert wait_until(lambda querier=querier: querier.matching_status.matching)
        replies = list(querier.get(payload=EMPTY_REQUEST, attachment=attachment(9, 1, gid)))
        assert len(replies) == 1 and str(replies[0].ok.key_expr) == where
        assert node.types.decode(TRIGGER + "_Response", replies[0].ok.payload.to_bytes()) == response
        number, _, back = read_attachment(replies[0].ok.attachment.to_bytes())  # type: ignore[misc]
        assert (number, back) == (9, gid)
        assert [reply for reply in querier.get(payload=EMPTY_REQUEST) if reply.ok] == [], "it is no request of ROS 2"
        for hostile in (b"", b"\xff" * 100, b"\0\1\0\0" + b"\xff" * 5000):
            assert [reply for reply in querier.get(payload=hostile, attachment=attachment(9, 1, gid)) if reply.ok] == []


def test_a_server_of_rmw_zenoh_is_called(pair: tuple[ZenohNode, Any]) -> None:
    node, session = pair
    response = node.types.make(TRIGGER + "_Response", success=True, message="theirs")
    where = "7/trigger/std_srvs::srv::dds_::Trigger_/RIHS01_other"
    seen: list[Any] = []

    def reply(query: Any) -> None:
        seen.append((query.payload.to_bytes(), read_attachment(query.attachment.to_bytes())))
        content = node.types.encode(TRIGGER + "_Response", response)
        query.reply(where, content, attachment=query.attachment.to_bytes())

    session.declare_queryable(where, reply, complete=True)
    place = "@ros2_lv/7/aac3178e146ba6f1fc6e6a4085e77f21/0/10/SS/%/%/server"
    shown = f"{place}/%trigger/std_srvs::srv::dds_::Trigger_/RIHS01_other/::,10:,:,:,,"
    token = session.liveliness().declare_token(shown)
    assert node.call("/trigger", TRIGGER, node.types.make(TRIGGER + "_Request"), 5) == response
    assert len(seen) == 1 and seen[0][0] == EMPTY_REQUEST and seen[0][1] is not None
    token.undeclare()


def test_latched_messages_are_those_of_advanced_publishers(pair: tuple[ZenohNode, Any]) -> None:
    from zenoh import ext

    node, session = pair
    publisher = node.publisher("/map", TEXT, LATCHED)
    publisher.send(HELLO)
    got: list[Any] = []
    where = f"7/map/{TEXT_KEY}/{node.types.hash(TEXT)}"
    history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
    recovery = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
    ext.declare_advanced_subscriber(session, where, got.append, history=history, recovery=recovery)
    assert wait_until(lambda: len(got) == 1) and got[0].payload.to_bytes() == HELLO
    theirs = ext.declare_advanced_publisher(
        session, f"7/other/{TEXT_KEY}/RIHS01_0", cache=ext.CacheConfig(1), publisher_detection=True
    )
    theirs.put(HELLO, attachment=attachment(1, 0, gid_of("theirs")))
    late: list[Received] = []
    node.subscribe("/other", TEXT, LATCHED, late.append)
    assert wait_until(lambda: len(late) == 1) and late[0].content == HELLO


def test_addresses_that_cannot_be_used_are_named() -> None:
    began = time.monotonic()
    with pytest.raises(MiddlewareError, match="tcp/256.0.0.1:1"):
        ZenohNode(NodeRequest("zenoh", 7, "", "listen:tcp/256.0.0.1:1", "jazzy"), "own")
    node = ZenohNode(NodeRequest("zenoh", 7, "", f"tcp/127.0.0.1:{free_port()}", "jazzy"), "own")
    node.close()  # nobody is there yet: it may come
    assert time.monotonic() - began < 5
