# SPDX-License-Identifier: Apache-2.0
"""Contents with nothing in them are told as such, by all outlets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kept_node import KeptNode
from message_samples import STAMP, sample_contents, sample_mesh, sample_points, sample_splats
from second_readers import cloud_table, read_foxglove, read_ros2

from ggslam.messages.contents import (
    Channel,
    Content,
    Mesh,
    Picture,
    Points,
    Splats,
    Things,
    Transforms,
    Verdicts,
)
from ggslam.messages.contents import Path as PathContent
from ggslam.messages.foxglove_outlet import FileOutlet
from ggslam.messages.ros2_outlet import Ros2Outlet
from ggslam.middleware.types import message_types

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")
pytest.importorskip("foxglove")
pytest.importorskip("google.protobuf")

NOTHING: dict[Channel, Content] = {
    Channel("/tf", Transforms): Transforms(()),
    Channel("path", PathContent): PathContent("map", np.zeros((0, 4, 4)), np.zeros(0)),
    Channel("points", Points): sample_points(0),
    Channel("bare", Points): Points("map", np.zeros((0, 3), np.float32)),
    Channel("splats", Splats): sample_splats(0, 1),
    Channel("mesh", Mesh): sample_mesh(vertices=0, triangles=0),
    Channel("objects", Things): Things("map", ()),
    Channel("/diagnostics", Verdicts): Verdicts(()),
}


def test_over_ros2() -> None:
    node = KeptNode()
    outlet = Ros2Outlet(node, message_types("jazzy"))
    for channel, content in NOTHING.items():
        outlet.open(channel)
        assert outlet.send(channel, content, STAMP) > 0
    found = {topic: read_ros2(p.kind, p.sent[0]) for topic, p in node.publishers.items() if p.sent}
    assert len(found["/tf"].transforms) == len(found["/path"].poses) == len(found["/points"].data) == 0
    assert [m.action for m in found["/mesh"].markers] == [3, 2]
    assert [m.action for m in found["/objects/markers"].markers] == [3]
    assert found["/objects"].detections == found["/diagnostics"].status == []
    assert [f.name for f in found["/bare"].fields] == ["x", "y", "z"]


def test_in_a_file(tmp_path: Path) -> None:
    outlet = FileOutlet(tmp_path / "empty.mcap")
    for channel, content in NOTHING.items():
        outlet.open(channel)
        outlet.send(channel, content, STAMP)
    outlet.close()
    found = {topic: messages[0] for topic, messages in read_foxglove(tmp_path / "empty.mcap").items()}
    assert set(found) == {"/" + channel.name.lstrip("/") for channel in NOTHING}
    assert len(found["/tf"].transforms) == len(found["/path"].poses) == len(cloud_table(found["/splats"])) == 0
    assert [deletion.id for deletion in found["/mesh"].deletions] == ["a"]


def test_pictures_without_pixels_are_left_out(tmp_path: Path) -> None:
    outlet = FileOutlet(tmp_path / "none.mcap")
    channel = next(channel for channel in sample_contents() if channel.kind is Picture)
    outlet.open(channel)
    assert outlet.send(channel, Picture("camera", np.zeros((0, 5, 3), np.uint8)), STAMP) == 0
    assert outlet.left_out() == 1
    outlet.close()


def test_a_file_that_nothing_was_told_to_is_not_left_behind(tmp_path: Path) -> None:
    outlet = FileOutlet(tmp_path / "none.mcap")
    outlet.open(next(iter(NOTHING)))
    outlet.close()
    assert not list(tmp_path.iterdir())
    again = FileOutlet(tmp_path / "none.mcap")  # the next try finds the name free
    channel, content = next(iter(NOTHING.items()))
    again.open(channel)
    again.send(channel, content, STAMP)
    again.close()
    again.close()
    assert (tmp_path / "none.mcap").stat().st_size > 100
