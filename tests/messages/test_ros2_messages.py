# SPDX-License-Identifier: Apache-2.0
"""Every message of ROS 2 says, read by another decoder, what was to be told."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from kept_node import KeptNode
from message_samples import (
    HUGE,
    STAMP,
    sample_contents,
    sample_grid,
    sample_mesh,
    sample_points,
    sample_splats,
    sample_things,
)
from second_readers import cloud_table, numbers_of, read_ros2, stamp_ns

from ggslam.messages.contents import Channel, Content, Grid, Mesh, Path, Picture, Points, Splats, Things
from ggslam.messages.pose_numbers import position_and_quaternion
from ggslam.messages.ros2_outlet import Ros2Outlet
from ggslam.messages.stamps import whole_nanoseconds
from ggslam.middleware.types import DISTRIBUTIONS, message_types

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")


def told(channel: Channel, content: Content, distribution: str = "jazzy", stamp: float = STAMP) -> dict[str, Any]:
    """What one content says over ROS 2, by topic; checks the size that the outlet tells."""
    node = KeptNode()
    outlet = Ros2Outlet(node, message_types(distribution))
    outlet.open(channel)
    size = outlet.send(channel, content, stamp)
    sent = {topic: publisher for topic, publisher in node.publishers.items() if publisher.sent}
    assert size == sum(len(publisher.sent[0]) for publisher in sent.values())
    return {topic: read_ros2(publisher.kind, publisher.sent[0], distribution) for topic, publisher in sent.items()}


def sample(name: str) -> tuple[Channel, Any]:
    return next((channel, content) for channel, content in sample_contents().items() if channel.name == name)


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_all_distributions_read_all(distribution: str) -> None:
    for channel, content in sample_contents().items():
        for message in told(channel, content, distribution).values():
            assert message is not None


def test_transforms() -> None:
    channel, content = sample("/tf")
    message = told(channel, content)["/tf"]
    assert [(t.header.frame_id, t.child_frame_id) for t in message.transforms] == [e[:2] for e in content.edges]
    for transform, edge in zip(message.transforms, content.edges, strict=True):
        assert stamp_ns(transform.header.stamp) == whole_nanoseconds(STAMP)
        t, q = transform.transform.translation, transform.transform.rotation
        expected = position_and_quaternion(edge[2])
        assert np.abs(np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w]) - expected).max() < 1e-12


def test_pose_and_path() -> None:
    channel, content = sample("pose")
    message = told(channel, content)["/pose"]
    assert np.abs(numbers_of(message.pose) - position_and_quaternion(content.T)).max() < 1e-12
    channel, content = sample("path")
    message = told(channel, content)["/path"]
    assert len(message.poses) == len(content.poses)
    for pose, T, stamp in zip(message.poses, content.poses, content.stamps, strict=True):
        assert np.abs(numbers_of(pose.pose) - position_and_quaternion(T)).max() < 1e-12
        assert stamp_ns(pose.header.stamp) == whole_nanoseconds(stamp)
        assert pose.header.frame_id == "karte_ü"


@pytest.mark.parametrize("frame", ["", "m", "map", "odom", "camera", "camera_1", "ü"])
@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_paths_of_any_frame_and_length(frame: str, count: int) -> None:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count)
    message = told(Channel("path", Path), Path(frame, poses, np.arange(count) / 4))["/path"]
    assert [pose.pose.position.x for pose in message.poses] == list(range(count))
    assert [pose.header.stamp.nanosec for pose in message.poses] == [k % 4 * 250_000_000 for k in range(count)]
    assert {pose.header.frame_id for pose in message.poses} <= {frame}


def test_pictures() -> None:
    channel, content = sample("image")
    message = told(channel, content)["/image/compressed"]
    decoded = cv2.imdecode(np.frombuffer(bytes(message.data), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(decoded.astype(int) - content.image).max() <= 8  # JPEG of a smooth image
    message = told(channel, Picture("camera", content.image, compressed=False))["/image"]
    assert (message.encoding, message.width, message.height, message.step) == ("rgb8", 64, 48, 192)
    assert bytes(message.data) == content.image.tobytes()
    channel, content = sample("depth")
    message = told(channel, content)["/depth/compressedDepth"]
    millimetres = cv2.imdecode(np.frombuffer(bytes(message.data)[12:], np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(millimetres, np.rint(content.image * 1000))


def test_lens() -> None:
    channel, content = sample("camera_info")
    message = told(channel, content)["/camera_info"]
    assert np.array_equal(np.array(message.k).reshape(3, 3), content.camera.matrix())
    assert (message.width, message.height, message.header.frame_id) == (64, 48, "camera")


@pytest.mark.parametrize("count", [0, 1, 300])
def test_points(count: int) -> None:
    content = sample_points(count)
    message = told(Channel("points", Points), content)["/points"]
    table = cloud_table(message)
    assert (message.width, message.height, message.row_step, message.is_dense) == (count, 1, count * 22, True)
    assert np.array_equal(np.stack([table[n] for n in "xyz"], 1).view(np.uint32), content.xyz.view(np.uint32))
    packed = table["rgb"].copy().view(np.uint32)
    assert np.array_equal(np.stack([packed >> 16, packed >> 8 & 255, packed & 255], 1), content.rgb)
    for name, column in content.values.items():
        assert np.array_equal(table[name], column)


def test_points_that_are_not_numbers_are_told_as_such() -> None:
    content = Points("map", np.full((2, 3), np.nan, np.float32))
    message = told(Channel("points", Points), content)["/points"]
    assert not message.is_dense
    assert np.isnan(cloud_table(message)["x"]).all()


def test_splats_as_3dgs_writes_them() -> None:
    content = sample_splats()
    table = cloud_table(told(Channel("splats", Splats), content)["/splats"])
    assert np.abs(np.exp(table["scale_1"]) - content.scales[:, 1]).max() < 1e-6
    assert np.abs(1 / (1 + np.exp(-table["opacity"])) - content.opacities).max() < 1e-6
    assert np.array_equal(np.stack([table[f"rot_{k}"] for k in range(4)], 1), content.quaternions)
    assert np.array_equal(np.stack([table[f"f_dc_{k}"] for k in range(3)], 1), content.sh[:, 0])
    rest = np.stack([table[f"f_rest_{k}"] for k in range(9)], 1)
    assert np.array_equal(rest, content.sh[:, 1:].transpose(0, 2, 1).reshape(-1, 9))
    assert np.array_equal(table["id"], content.ids)


@pytest.mark.parametrize("colored", [True, False])
def test_mesh(colored: bool) -> None:
    content = sample_mesh(colored=colored)
    clear, marker = told(Channel("mesh", Mesh), content)["/mesh"].markers
    assert (clear.action, marker.action, marker.type) == (3, 0, 11)
    points = np.array([[p.x, p.y, p.z] for p in marker.points])
    assert np.array_equal(points, content.vertices[content.triangles].reshape(-1, 3))
    colors = np.array([[c.r, c.g, c.b, c.a] for c in marker.colors]).reshape(-1, 4)
    if content.rgb is None:
        assert len(colors) == 0
    else:
        assert np.array_equal(np.rint(colors[:, :3] * 255), content.rgb[content.triangles].reshape(-1, 3))
        assert (colors[:, 3] == 1).all()


def test_grid() -> None:
    content = sample_grid()
    message = told(Channel("grid", Grid), content)["/grid"]
    assert np.array_equal(np.array(message.data, np.int8).reshape(7, 11), content.cells)
    assert (message.info.width, message.info.height) == (11, 7)
    assert abs(message.info.resolution - 0.05) < 1e-8
    assert np.abs(numbers_of(message.info.origin)[:3] - [-1.5, 2.5, 0.1]).max() < 1e-12
    part = sample_grid(2, 3, at=(4, 5))
    message = told(Channel("grid", Grid), part)["/grid_updates"]
    assert (message.x, message.y, message.width, message.height) == (5, 4, 3, 2)
    assert np.array_equal(np.array(message.data, np.int8).reshape(2, 3), part.cells)


def test_things() -> None:
    content = sample_things()
    messages = told(Channel("objects", Things), content)
    for detection, thing in zip(messages["/objects"].detections, content.things, strict=True):
        assert detection.id == str(thing.id)
        assert detection.results[0].hypothesis.score == thing.score
        assert np.abs(numbers_of(detection.bbox.center) - position_and_quaternion(thing.T)).max() < 1e-12
        size = detection.bbox.size
        assert np.array_equal([size.x, size.y, size.z], thing.size)
    assert messages["/objects"].detections[1].id == str(HUGE)
    assert len(messages["/objects"].detections[1].results[0].hypothesis.class_id) == 500
    assert messages["/objects"].detections[2].results[0].hypothesis.class_id == "chair "
    markers = messages["/objects/markers"].markers
    assert [m.action for m in markers if m.ns == "boxes"] == [0, 0, 0]
    assert [m.id for m in markers if m.ns == "boxes"] == [5, -1, 7]
    assert [m.text for m in markers if m.ns == "names"][2] == "chair : moved"
    arrow = next(m for m in markers if m.ns == "velocities" and m.action == 0)
    velocity = content.things[1].velocity
    assert velocity is not None
    x, y, z, w = numbers_of(arrow.pose)[3:]
    ahead = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    assert np.abs(np.array(ahead) * arrow.scale.x - velocity).max() < 1e-9
    box = next(m for m in markers if m.ns == "boxes")
    assert np.abs(np.array([box.color.r, box.color.g, box.color.b]) - [1, 0, 0.2]).max() < 1e-6


def test_verdicts() -> None:
    channel, content = sample("/diagnostics")
    message = told(channel, content)["/diagnostics"]
    levels = [s.level if isinstance(s.level, int) else s.level[0] for s in message.status]
    assert levels == [0, 2]
    assert [(s.name, s.message) for s in message.status] == [("tracking", "fine"), ("depth", "no depth")]
    assert [(v.key, v.value) for v in message.status[1].values] == [("frames", "7")]
