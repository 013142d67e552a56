# SPDX-License-Identifier: Apache-2.0
"""Points, Gaussians and grids in Foxglove's schemas: packed fields. Verdicts as JSON."""

from __future__ import annotations

import json
from typing import Any, Final

import numpy as np

from ggslam.messages.contents import Grid, Points, Splats, Verdicts
from ggslam.messages.foxglove_package import foxglove_messages, pose, timestamp
from ggslam.messages.point_rows import columns_of, point_rows, splat_rows
from ggslam.messages.ros2_lists import LEVELS
from ggslam.messages.sound_content import plain_text
from ggslam.messages.stamps import seconds_and_nanoseconds

NUMBERS: Final = {"|u1": "Uint8", "|i1": "Int8", "<u2": "Uint16", "<f4": "Float32"}
"""Foxglove's names of types."""
_TIME: Final = {
    "type": "object",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}
_TEXT: Final = {"type": "string"}
_PAIR: Final = {"type": "object", "properties": {"key": _TEXT, "value": _TEXT}}
VERDICTS_SCHEMA: Final[dict[str, Any]] = {
    "title": "diagnostic_msgs/DiagnosticArray",
    "type": "object",
    "properties": {
        "header": {"type": "object", "properties": {"stamp": _TIME, "frame_id": _TEXT}},
        "status": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "level": {"type": "integer"}, "name": _TEXT, "message": _TEXT, "hardware_id": _TEXT,
                    "values": {"type": "array", "items": _PAIR},
                },
            },
        },
    },
}  # fmt: skip
"""As ROS's diagnostics, whose name Foxglove's panels look for."""


def cloud_message(content: Points | Splats, stamp: float) -> bytes:
    """foxglove.PointCloud."""
    rows = point_rows(content, "columns") if isinstance(content, Points) else splat_rows(content, "columns")
    fields = [_field(*column) for column in columns_of(rows)]
    made = foxglove_messages().PointCloud(
        timestamp=timestamp(stamp), frame_id=plain_text(content.frame), pose=pose(np.eye(4)),
        point_stride=rows.dtype.itemsize, fields=fields, data=rows.tobytes(),
    )  # fmt: skip
    return bytes(made.encode())


def grid_message(content: Grid, stamp: float) -> bytes:
    """foxglove.Grid, row 0 at the origin."""
    kinds = foxglove_messages()
    made = kinds.Grid(
        timestamp=timestamp(stamp), frame_id=plain_text(content.frame), pose=pose(content.T_frame_origin),
        column_count=content.cells.shape[1], cell_size=kinds.Vector2(x=content.cell_m, y=content.cell_m),
        row_stride=content.cells.shape[1], cell_stride=1, fields=[_field("occupancy", "|i1", 0)],
        data=np.ascontiguousarray(content.cells, np.int8).tobytes(),
    )  # fmt: skip
    return bytes(made.encode())


def _field(name: str, kind: str, offset: int) -> Any:
    kinds = foxglove_messages()
    number = getattr(kinds.PackedElementFieldNumericType, NUMBERS[kind])
    return kinds.PackedElementField(name=name, offset=offset, type=number)


def verdicts_message(content: Verdicts, stamp: float) -> bytes:
    """JSON of VERDICTS_SCHEMA."""
    seconds, nanoseconds = seconds_and_nanoseconds(stamp)
    status = [
        {
            "level": LEVELS[verdict.level], "name": plain_text(verdict.name), "message": plain_text(verdict.text),
            "hardware_id": "ggslam",
            "values": [{"key": plain_text(k), "value": plain_text(v)} for k, v in verdict.values.items()],
        }
        for verdict in content.verdicts
    ]  # fmt: skip
    head = {"stamp": {"sec": seconds, "nsec": nanoseconds}, "frame_id": ""}
    return json.dumps({"header": head, "status": status}).encode()
