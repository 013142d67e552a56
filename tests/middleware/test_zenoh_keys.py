# SPDX-License-Identifier: Apache-2.0
"""Keys, tokens and attachments are those of rmw_zenoh_cpp's design document."""

from __future__ import annotations

import pytest

from ggslam.errors import MiddlewareError
from ggslam.middleware import zenoh_keys as keys
from ggslam.middleware.node import LATCHED, SENSOR_DATA, Qos
from ggslam.middleware.zenoh_session import endpoints, settings

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
SUM_HASH = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
LISTENER = (
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/"
    f"{STRING_HASH}/::,10:,:,:,,"
)
SERVER = (
    "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server/%add_two_ints/"
    f"example_interfaces::srv::dds_::AddTwoInts_/{SUM_HASH}/::,10:,:,:,,"
)


def test_keys() -> None:
    text = "std_msgs/msg/String"
    assert keys.key(0, "/chatter", text, STRING_HASH) == f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert keys.key(0, "/robot1/chatter", text, "*") == "0/robot1/chatter/std_msgs::msg::dds_::String_/*"
    wanted = f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{SUM_HASH}"
    assert keys.key(2, "/add_two_ints", "example_interfaces/srv/AddTwoInts", SUM_HASH) == wanted


def test_tokens() -> None:
    mark = keys.NodeMark(2, "aac3178e146ba6f1fc6e6a4085e77f21", "/", "listener")
    assert mark.node_token() == "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    assert mark.token(10, "MS", "/chatter", "std_msgs/msg/String", STRING_HASH, Qos()) == LISTENER
    mark = keys.NodeMark(2, "f9980ee0495eaafb3e38f0d19e2eae12", "/", "add_two_ints_server")
    assert mark.token(10, "SS", "/add_two_ints", "example_interfaces/srv/AddTwoInts", SUM_HASH, Qos()) == SERVER
    assert keys.NodeMark(0, "1", "/a/b", "c").node_token() == "@ros2_lv/0/1/0/0/NN/%/%a%b/c"


def test_tokens_are_read() -> None:
    assert keys.read_token(LISTENER) == keys.Shown("MS", "/chatter", "std_msgs/msg/String", STRING_HASH)
    assert keys.read_token(SERVER) == keys.Shown("SS", "/add_two_ints", "example_interfaces/srv/AddTwoInts", SUM_HASH)
    for other in ("", "@ros2_lv/0/1/0/0/NN/%/%/c", LISTENER.replace("MS", "XX"), "a/" * 13, LISTENER[:60]):
        assert keys.read_token(other) is None


def test_quality_of_service() -> None:
    assert keys.qos_text(SENSOR_DATA) == "2::,5:,:,:,,"
    assert keys.qos_text(LATCHED) == ":1:,1:,:,:,,"


def test_attachments() -> None:
    gid = bytes(range(16))
    content = keys.attachment(7, 9, gid)
    assert content == b"\7" + bytes(7) + b"\x09" + bytes(7) + b"\x10" + gid and len(content) == 33
    assert keys.read_attachment(content) == (7, 9, gid)
    for bad in (b"", content[:-1], content[:16] + b"\x0f" + gid, b"\xff" * 33):
        assert keys.read_attachment(bad) is None


def test_addresses() -> None:
    assert endpoints("") == ([], [])
    where = "tcp/10.0.0.1:7447, listen:tcp/127.0.0.1:7450"
    assert endpoints(where) == (["tcp/10.0.0.1:7447"], ["tcp/127.0.0.1:7450"])
    with pytest.raises(MiddlewareError, match="10.0.0.1"):
        endpoints("10.0.0.1")
    assert settings("")["connect/endpoints"] == ["tcp/localhost:7447"] and settings("")["scouting/multicast/enabled"]
    assert not settings(where)["scouting/multicast/enabled"]
    assert settings("listen:tcp/127.0.0.1:1")["connect/endpoints"] == []
