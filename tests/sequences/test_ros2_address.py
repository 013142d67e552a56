# SPDX-License-Identifier: Apache-2.0
"""Addresses of live topics."""

from __future__ import annotations

from pathlib import Path

import pytest

from ggslam.errors import GgslamError
from ggslam.middleware.opening import NodeRequest
from ggslam.sequences.formats.ros2_address import TopicsAddress, add_network, parse_address
from ggslam.sequences.live import is_live


def test_addresses() -> None:
    found = parse_address("ros2://camera/color,camera/depth")
    assert found == TopicsAddress({"color": "/camera/color", "depth": "/camera/depth"})
    assert parse_address(str(Path("ros2://camera/color,camera/depth"))) == found  # paths keep one slash
    assert is_live(Path("ros2://camera/color,camera/depth"))
    text = (
        "ros2://a,depth=/d,color_info=i?middleware=dds&domain=3&namespace=robot1&qos=reliable&tolerance=0.05&idle=2"
        "&wait=1&address=127.0.0.1&distribution=humble"
    )
    assert parse_address(text) == TopicsAddress(
        {"color": "/robot1/a", "depth": "/d", "color_info": "/robot1/i"},
        NodeRequest("dds", 3, "robot1", "127.0.0.1", "humble"), True, 0.05, 1.0, 2.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ros2://a", "expected ros2://COLOR,DEPTH"), ("ros2:/a", "ros2://a: expected"), ("ros2:", "expected ros2://COLOR,DEPTH"),
        ("ros2://a,b,c,d,e", "found 'e'"), ("ros2://a,b,color=c", "found 'color=c'"), ("ros2://a,", "found ''"),
        ("ros2://a,b?speed=3", "found 'speed'"), ("ros2://a,b?domain=233", "domain: expected a number from 0 to 232"),
        ("ros2://a,b?idle=-1", "idle: expected seconds, above 0, found '-1'"), ("ros2://a,b?qos=best", "reliable or"),
        ("ros2://a,b?middleware=ice", "zenoh or dds, found 'ice'"), ("ros2://a b,c", "`/a b` is no name of a topic"),
        ("ros2://a,b?wait=nan", "wait: expected seconds"), ("realsense:a,b", "expected ros2://"),
    ],
)  # fmt: skip
def test_no_addresses(text: str, words: str) -> None:
    with pytest.raises(GgslamError, match=words.replace("?", r"\?")):
        parse_address(text)


def test_network_of_options() -> None:
    place = Path("ros2://a,b?idle=2")
    assert add_network(place, NodeRequest()) == place
    full = add_network(place, NodeRequest("dds", 3, "/robot1", "tcp/10.0.0.1:7447"))
    assert parse_address(str(full)).node == NodeRequest("dds", 3, "/robot1", "tcp/10.0.0.1:7447")
    assert parse_address(str(full)).idle_s == 2.0 and add_network(Path(str(full)), NodeRequest(domain=7)) == full
