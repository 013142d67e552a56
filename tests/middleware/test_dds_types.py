# SPDX-License-Identifier: Apache-2.0
"""Messages are those of DDS's own types: a program with plain cyclonedds reads and writes them."""

import random
from dataclasses import dataclass

import pytest
from networks import wait_until

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")
from cyclonedds.core import Policy, Qos
from cyclonedds.idl import IdlStruct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from ggslam.errors import MiddlewareError
from ggslam.middleware import node as ours
from ggslam.middleware.dds_domain import DOMAINS, configuration
from ggslam.middleware.dds_node import DdsNode
from ggslam.middleware.dds_services import request_header, with_header, without_header
from ggslam.middleware.dds_types import RawTypes
from ggslam.middleware.types import message_types

IMAGE = "sensor_msgs/msg/Image"


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: types.int32
    nanosec: types.uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    header: Header
    height: types.uint32
    width: types.uint32
    encoding: str
    is_bigendian: types.uint8
    step: types.uint32
    data: types.sequence[types.uint8]


def plain(number: int) -> Image:
    return Image(Header(Time(number, 5), "camera"), 2, 3, "rgb8", 0, 9, [i % 256 for i in range(18)])


def padded(content: bytes) -> bytes:
    """cyclonedds fills a sample up to whole words."""
    return content.ljust(len(content) + 3 & ~3, b"\0")


@pytest.fixture
def domain() -> int:
    return random.randrange(100, 200)


def test_plain_cyclonedds_and_a_node_read_each_other(domain: int) -> None:
    node = DdsNode(ours.NodeRequest("dds", domain, "", "127.0.0.1", "jazzy"), "own")
    participant = DOMAINS.join(domain, "127.0.0.1")
    reliable = Qos(
        Policy.Reliability.Reliable(0), Policy.History.KeepLast(20),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )  # fmt: skip
    topic = Topic(participant, "rt/camera/color", Image)
    writer, reader = DataWriter(participant, topic, reliable), DataReader(participant, topic, reliable)
    got: list[ours.Received] = []
    node.subscribe("/camera/color", IMAGE, ours.Qos(depth=20), got.append)
    publisher = node.publisher("/camera/color", IMAGE, ours.Qos(depth=20))
    assert wait_until(lambda: publisher.subscribers == 2 and len(writer.get_matched_subscriptions()) == 2)
    for number in range(5):
        writer.write(plain(number))
    assert wait_until(lambda: len(got) == 5)
    for number, received in enumerate(got):
        message = node.types.decode(IMAGE, received.content)
        assert padded(node.types.encode(IMAGE, message)) == padded(plain(number).serialize())
        publisher.send(node.types.encode(IMAGE, message))
    assert wait_until(lambda: len(got) == 10)
    read = reader.take(20)
    assert read[:5] == read[5:] == [plain(number) for number in range(5)]
    assert [padded(r.content) for r in got[:5]] == [padded(r.content) for r in got[5:]], "the same bytes from both"
    DOMAINS.leave(domain, participant)
    node.close()


def test_nodes_are_shown(domain: int) -> None:
    """On the topic by which rmw_cyclonedds_cpp tells which node has which readers and writers."""
    node = DdsNode(ours.NodeRequest("dds", domain, "robot", "127.0.0.1", "jazzy"), "own")
    node.publisher("points", IMAGE, ours.Qos())
    node.subscribe("/camera/color", IMAGE, ours.Qos(), print)
    participant = DOMAINS.join(domain, "127.0.0.1")
    kind = "rmw_dds_common/msg/ParticipantEntitiesInfo"
    topic = Topic(participant, "ros_discovery_info", RawTypes(node.types).raw(kind))
    latched = [Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal, Policy.History.KeepAll]
    reader, got = DataReader(participant, topic, Qos(*latched)), []
    assert wait_until(lambda: bool(got.extend(reader.take(10)) or got))
    seen = node.types.decode(kind, got[-1].content)
    (shown,) = seen.node_entities_info_seq
    assert (shown.node_namespace, shown.node_name) == ("/robot", "own")
    assert len(shown.reader_gid_seq) == len(shown.writer_gid_seq) == 1
    assert bytes(seen.gid.data[:12]) == bytes(shown.writer_gid_seq[0].data[:12])
    assert node.topics() == {"/robot/points": IMAGE, "/camera/color": IMAGE}
    DOMAINS.leave(domain, participant)
    node.close()


def test_types_have_the_members_of_ros() -> None:
    raw = RawTypes(message_types("jazzy"))
    made = raw.raw(IMAGE)
    assert made.__idl__.idl_transformed_typename == Image.__idl__.idl_transformed_typename  # type: ignore[attr-defined]
    for kind in (made, Image):
        kind.__idl__.populate()  # type: ignore[attr-defined]
        kind.__idl__.fill_type_data()  # type: ignore[attr-defined]
    minimal = [kind.__idl__.get_type_info().minimal.typeid_with_size for kind in (made, Image)]  # type: ignore
    assert minimal[0] == minimal[1]


def test_a_type_of_another_name_is_not_matched(domain: int) -> None:
    node = DdsNode(ours.NodeRequest("dds", domain, "", "127.0.0.1", "jazzy"), "own")
    node.subscribe("/x", "std_msgs/msg/String", ours.Qos(), print)
    publisher = node.publisher("/x", "std_msgs/msg/Header", ours.Qos())
    assert not wait_until(lambda: publisher.subscribers > 0, 0.3)
    best_effort = node.publisher("/x", "std_msgs/msg/String", ours.SENSOR_DATA)
    assert not wait_until(lambda: best_effort.subscribers > 0, 0.3), "it offers less than is wanted"
    node.close()


def test_a_process_has_one_address_a_domain(domain: int) -> None:
    first = DOMAINS.join(domain, "127.0.0.1")
    with pytest.raises(MiddlewareError, match="192.168.77.1"):
        DOMAINS.join(domain, "192.168.77.1")
    DOMAINS.leave(domain, first)
    with pytest.raises(MiddlewareError, match="192.168.77.1"):
        DOMAINS.join(domain, "192.168.77.1")  # no interface has it
    DOMAINS.leave(domain, DOMAINS.join(domain, "127.0.0.1"))
    with pytest.raises(MiddlewareError, match="0 to 232"):
        DOMAINS.join(233, "127.0.0.1")


def test_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    assert '<NetworkInterface address="127.0.0.1"/>' in configuration("127.0.0.1")
    assert '<NetworkInterface name="eth0"/>' in configuration("eth0") and "Multicast" not in configuration("eth0")
    assert "Interface" not in configuration("")
    monkeypatch.setenv("CYCLONEDDS_URI", "file:///x.xml")
    assert configuration("").endswith(",file:///x.xml"), "what the user says counts"


def test_headers_of_services() -> None:
    payload = b"\0\1\0\0abcd"
    whole = with_header(7, -2, payload)
    assert whole == b"\0\1\0\0" + b"\7" + bytes(7) + b"\xfe" + b"\xff" * 7 + b"abcd"
    assert request_header(whole) == (7, -2) and without_header(whole) == payload
    assert request_header(b"\0\0\0\0" + bytes(7) + b"\7" + bytes(7) + b"\1") == (7, 1), "of a big-endian machine"
    assert request_header(whole[:19]) is None
