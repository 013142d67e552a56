# SPDX-License-Identifier: Apache-2.0
"""What the outlet of ROS 2 does between contents: topics, deletions, listeners, what is left out."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from kept_node import KeptNode
from message_samples import sample_contents, sample_mesh, sample_things
from second_readers import read_ros2

from ggslam.messages.contents import Channel, Grid, Mesh, Picture, Points, Pose, Things, Transforms
from ggslam.messages.ros2_outlet import Ros2Outlet
from ggslam.middleware.types import message_types

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")


def outlet_of(*channels: Channel, namespace: str = "/") -> tuple[Ros2Outlet, KeptNode]:
    node = KeptNode(namespace)
    outlet = Ros2Outlet(node, message_types("jazzy"))
    for channel in channels:
        outlet.open(channel)
    return outlet, node


def last(node: KeptNode, topic: str) -> Any:
    publisher = node.publishers[topic]
    return read_ros2(publisher.kind, publisher.sent[-1])


def test_topics_stand_in_the_namespace_unless_they_begin_with_a_slash() -> None:
    _, node = outlet_of(*sample_contents(), namespace="/robot1")
    assert {"/tf", "/diagnostics", "/robot1/pose", "/robot1/objects", "/robot1/objects/markers", "/robot1/grid_updates",
            "/robot1/image/compressed", "/robot1/depth/compressedDepth"} <= set(node.publishers)  # fmt: skip
    assert node.publishers["/robot1/grid"].qos.latched
    assert not node.publishers["/robot1/grid_updates"].qos.latched


def test_things_that_went_away_are_deleted() -> None:
    channel = Channel("objects", Things)
    outlet, node = outlet_of(channel)
    all_things = sample_things()
    outlet.send(channel, all_things, 1.0)
    assert last(node, "/objects/markers").markers[0].action == 3  # what an earlier process left
    outlet.send(channel, Things("map", all_things.things[:1]), 2.0)
    markers = last(node, "/objects/markers").markers
    assert {(m.ns, m.id) for m in markers if m.action == 2} - {("velocities", 5)} == {
        (family, number) for family in ("boxes", "names", "velocities") for number in (-1, 7)
    }
    assert len(last(node, "/objects").detections) == 1
    outlet.send(channel, Things("map", ()), 3.0)
    assert {m.action for m in last(node, "/objects/markers").markers} == {2}
    outlet.send(channel, Things("map", ()), 4.0)
    assert last(node, "/objects/markers").markers == []


def test_parts_of_a_mesh_have_numbers_and_go() -> None:
    channel = Channel("mesh", Mesh)
    outlet, node = outlet_of(channel)
    numbers = {}
    for part in ("a", "b", "a"):
        outlet.send(channel, sample_mesh(part), 1.0)
        numbers.setdefault(part, set()).add(last(node, "/mesh").markers[-1].id)
    assert [len(found) for found in numbers.values()] == [1, 1]
    assert numbers["a"] != numbers["b"]
    outlet.send(channel, sample_mesh("a", triangles=0), 2.0)
    (marker,) = last(node, "/mesh").markers
    assert (marker.action, {marker.id}) == (2, numbers["a"])


def test_fixed_transforms_are_all_in_the_last_message() -> None:
    channel = Channel("/tf_static", Transforms, latched=True)
    outlet, node = outlet_of(channel)
    T = np.eye(4)
    outlet.send(channel, Transforms((("map", "a", T),), fixed=True), 1.0)
    outlet.send(channel, Transforms((("map", "b", T),), fixed=True), 2.0)
    outlet.send(channel, Transforms((("b", "a", T),), fixed=True), 3.0)
    message = last(node, "/tf_static")
    assert {(t.header.frame_id, t.child_frame_id) for t in message.transforms} == {("b", "a"), ("map", "b")}


def test_pictures_are_sent_as_somebody_listens() -> None:
    channel = Channel("image", Picture)
    outlet, node = outlet_of(channel)
    picture = next(content for made, content in sample_contents().items() if made.name == "image")

    def sent() -> list[str]:
        return [topic for topic, publisher in node.publishers.items() if publisher.sent]

    outlet.send(channel, picture, 1.0)
    assert sent() == ["/image/compressed"]
    node.publishers["/image"].subscribers = 1
    assert outlet.listeners(channel) == 1
    before = len(node.publishers["/image/compressed"].sent)
    outlet.send(channel, picture, 2.0)
    assert len(node.publishers["/image"].sent) == 1
    assert len(node.publishers["/image/compressed"].sent) == before


def test_joins_are_told() -> None:
    channels = Channel("grid", Grid, True), Channel("points", Points)
    outlet, node = outlet_of(*channels)
    told: list[Channel] = []
    event = threading.Event()
    outlet.on_join(lambda channel: (told.append(channel), event.set()))
    for _ in range(2):
        event.clear()
        node.publishers["/grid"].subscribers += 1
        assert event.wait(5)
    outlet.close()
    assert told == [channels[0]] * 2


def test_what_cannot_be_told_is_left_out_and_counted() -> None:
    pose, things, mesh = Channel("pose", Pose), Channel("objects", Things), Channel("mesh", Mesh)
    tf = Channel("/tf", Transforms)
    outlet, node = outlet_of(pose, things, mesh, tf)
    broken = np.eye(4)
    broken[0, 3] = np.nan
    assert outlet.send(pose, Pose("map", broken), 1.0) == 0
    assert outlet.left_out() == 1
    assert not node.publishers["/pose"].sent
    good = sample_things().things
    endless = replace(good[2], size=np.full(3, np.inf))
    outlet.send(things, Things("map", (good[0], replace(good[1], T=broken), endless)), 1.0)
    assert [d.id for d in last(node, "/objects").detections] == ["5"]
    outlet.send(tf, Transforms((("a", "b", np.eye(4)), ("b", "c", broken))), 1.0)
    assert [t.child_frame_id for t in last(node, "/tf").transforms] == ["b"]
    assert outlet.send(tf, Transforms((("b", "c", broken),)), 1.0) == 0
    content = sample_mesh()
    content.vertices[content.triangles[0, 0]] = np.nan
    outlet.send(mesh, content, 1.0)
    points = last(node, "/mesh").markers[-1].points
    assert 0 < len(points) < content.triangles.size
    assert all(np.isfinite([p.x, p.y, p.z]).all() for p in points)
    node.publishers["/mesh"].left_out = 3
    assert outlet.left_out() == 5
    outlet.close()
    assert outlet.left_out() == 5
    assert all(publisher.closed for publisher in node.publishers.values())
