# SPDX-License-Identifier: Apache-2.0
"""Names of topics, nodes and types."""

from __future__ import annotations

import pytest

from ggslam.errors import MiddlewareError
from ggslam.middleware.names import check_kind, check_node_name, dds_kind, full_name, full_namespace, ros_kind


@pytest.mark.parametrize(
    ("namespace", "topic", "expected"),
    [
        ("", "points", "/points"),
        ("/", "points", "/points"),
        ("robot1", "points", "/robot1/points"),
        ("/robot1/", "camera/color", "/robot1/camera/color"),
        ("/robot1", "/tf", "/tf"),
    ],
)
def test_topics_lie_in_the_namespace(namespace: str, topic: str, expected: str) -> None:
    assert full_name(namespace, topic) == expected


@pytest.mark.parametrize("topic", ["", "/", "a b", "a/", "/1a", "a//b", "a__b", "~/a", "ä", "a/1", "x" * 300, "a*"])
def test_what_is_no_topic_is_refused(topic: str) -> None:
    with pytest.raises(MiddlewareError, match="is no name"):
        full_name("", topic)


def test_nodes_and_namespaces() -> None:
    assert full_namespace("") == "/" and full_namespace("a/b") == "/a/b"
    assert check_node_name("ggslam_1") == "ggslam_1"
    for bad in ("", "a/b", "1a", "a b"):
        with pytest.raises(MiddlewareError):
            check_node_name(bad)
    with pytest.raises(MiddlewareError):
        full_namespace("a b")


def test_types() -> None:
    assert dds_kind("sensor_msgs/msg/Image") == "sensor_msgs::msg::dds_::Image_"
    assert ros_kind("sensor_msgs::msg::dds_::Image_") == "sensor_msgs/msg/Image"
    assert ros_kind("std_srvs::srv::dds_::Trigger_Request_") == "std_srvs/srv/Trigger_Request"
    assert ros_kind("Image") is None
    with pytest.raises(MiddlewareError):
        check_kind("Image")
