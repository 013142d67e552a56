# SPDX-License-Identifier: Apache-2.0
"""The comparison of decoders sees what differs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")

from compared_decoders import differences
from second_readers import read_ros2

from ggslam.middleware.types import message_types

CLOUD = "sensor_msgs/msg/PointCloud2"


def cloud(**changed: Any) -> Any:
    types = message_types("jazzy")
    stamp = types.make("builtin_interfaces/msg/Time", sec=3, nanosec=4)
    header = types.make("std_msgs/msg/Header", stamp=stamp, frame_id="map")
    field = types.make("sensor_msgs/msg/PointField", name="x", offset=0, datatype=7, count=1)
    values = {
        "header": header, "height": 1, "width": 2, "fields": [field], "is_bigendian": False, "point_step": 4,
        "row_step": 8, "data": np.arange(8, dtype=np.uint8), "is_dense": True,
    }  # fmt: skip
    return types.make(CLOUD, **{**values, **changed})


def test_what_differs_is_seen() -> None:
    ours = cloud()
    assert differences(ours, read_ros2(CLOUD, message_types("jazzy").encode(CLOUD, ours))) == []
    for name, value in (("width", 3), ("is_dense", False), ("data", np.zeros(8, np.uint8)), ("fields", [])):
        other = read_ros2(CLOUD, message_types("jazzy").encode(CLOUD, cloud(**{name: value})))
        (found,) = differences(ours, other)
        assert found.startswith(f".{name}")
