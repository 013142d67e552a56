# SPDX-License-Identifier: Apache-2.0
"""Points and Gaussians as sensor_msgs/PointCloud2."""

from __future__ import annotations

from typing import Final

import numpy as np

from ggslam.messages.contents import Points, Splats
from ggslam.messages.point_rows import columns_of, point_rows, splat_rows
from ggslam.messages.ros2_images import header
from ggslam.messages.sound_content import plain_text
from ggslam.middleware.types import MessageTypes

CLOUD: Final = "sensor_msgs/msg/PointCloud2"
NUMBERS: Final = {"<u2": 4, "<f4": 7}
"""Numbers of sensor_msgs/PointField for types of columns."""
RGB: Final = 7
"""`rgb` is declared as float32, though it holds 0x00RRGGBB: PCL began it, and rviz and all others follow."""


def cloud_message(types: MessageTypes, content: Points | Splats, stamp: float) -> bytes:
    """sensor_msgs/PointCloud2 of one row."""
    rows = point_rows(content, "packed") if isinstance(content, Points) else splat_rows(content, "packed")
    fields = [
        types.make(
            "sensor_msgs/msg/PointField", name=name, offset=offset, datatype=RGB if name == "rgb" else NUMBERS[kind],
            count=1,
        )
        for name, kind, offset in columns_of(rows)
    ]  # fmt: skip
    finite = isinstance(content, Splats) or bool(np.isfinite(content.xyz).all())
    made = types.make(
        CLOUD, header=header(types, plain_text(content.frame), stamp), height=1, width=len(rows), fields=fields,
        is_bigendian=False, point_step=rows.dtype.itemsize, row_step=rows.nbytes, data=rows.view(np.uint8).reshape(-1),
        is_dense=finite,
    )  # fmt: skip
    return types.encode(CLOUD, made)
