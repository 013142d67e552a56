# SPDX-License-Identifier: Apache-2.0
"""Transforms, poses and paths as messages of tf2_msgs, geometry_msgs and nav_msgs. All functions return CDR."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from ggslam.messages.cdr_writer import CdrWriter
from ggslam.messages.contents import Path, Pose
from ggslam.messages.pose_numbers import position_and_quaternion
from ggslam.messages.sound_content import plain_text
from ggslam.messages.stamps import seconds_and_nanoseconds
from ggslam.middleware.types import MessageTypes

TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"
POSE: Final = "geometry_msgs/msg/PoseStamped"
PATH: Final = "nav_msgs/msg/Path"
Edge = tuple[str, str, np.ndarray, float]
"""Parent, child, T_parent_child, stamp."""


def vector(types: MessageTypes, xyz: np.ndarray, kind: str = "Vector3") -> Any:
    """geometry_msgs/Vector3 or Point."""
    return types.make(f"geometry_msgs/msg/{kind}", x=float(xyz[0]), y=float(xyz[1]), z=float(xyz[2]))


def quaternion(types: MessageTypes, xyzw: np.ndarray) -> Any:
    """geometry_msgs/Quaternion."""
    x, y, z, w = map(float, xyzw)
    return types.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def pose(types: MessageTypes, T: np.ndarray) -> Any:
    """geometry_msgs/Pose."""
    numbers = position_and_quaternion(T)
    return types.make(
        "geometry_msgs/msg/Pose", position=vector(types, numbers[:3], "Point"),
        orientation=quaternion(types, numbers[3:]),
    )  # fmt: skip


def transforms_message(edges: list[Edge]) -> bytes:
    """tf2_msgs/TFMessage. By hand, as it goes out after every frame."""
    writer = CdrWriter()
    writer.numbers("I", len(edges))
    for parent, child, T, stamp in edges:
        write_header(writer, plain_text(parent), stamp)
        writer.text(plain_text(child))
        writer.numbers("d", *position_and_quaternion(T))
    return writer.content()


def pose_message(content: Pose, stamp: float) -> bytes:
    """geometry_msgs/PoseStamped."""
    writer = CdrWriter()
    write_header(writer, plain_text(content.frame), stamp)
    writer.numbers("d", *position_and_quaternion(content.T))
    return writer.content()


def path_message(content: Path, stamp: float) -> bytes:
    """nav_msgs/Path."""
    frame = plain_text(content.frame)
    writer = CdrWriter()
    write_header(writer, frame, stamp)
    numbers = position_and_quaternion(content.poses)
    stamps = [seconds_and_nanoseconds(float(s)) for s in content.stamps]
    writer.numbers("I", len(stamps))
    if stamps:  # the first one may begin at half of 8 bytes, all others begin at 8
        write_header(writer, frame, float(content.stamps[0]))
        writer.numbers("d", *numbers[0])
        writer.rows(_stamped_rows(frame, stamps[1:], numbers[1:]), 8)
    return writer.content()


def write_header(writer: CdrWriter, frame: str, stamp: float) -> None:
    """std_msgs/Header."""
    seconds, nanoseconds = seconds_and_nanoseconds(stamp)
    writer.numbers("i", seconds)
    writer.numbers("I", nanoseconds)
    writer.text(frame)


def _stamped_rows(frame: str, stamps: list[tuple[int, int]], numbers: np.ndarray) -> np.ndarray:
    """PoseStamped of one frame as rows, each beginning and ending at a multiple of 8 bytes."""
    name = frame.encode() + b"\0"
    used = 12 + len(name)
    kind = np.dtype([
        ("seconds", "<i4"), ("nanoseconds", "<u4"), ("length", "<u4"), ("name", "u1", len(name)),
        ("filled", "u1", -used % 8), ("pose", "<f8", 7),
    ])  # fmt: skip
    rows = np.zeros(len(stamps), kind)
    times = np.array(stamps, np.int64).reshape(-1, 2)
    rows["seconds"], rows["nanoseconds"], rows["length"] = times[:, 0], times[:, 1], len(name)
    rows["name"], rows["pose"] = np.frombuffer(name, np.uint8), numbers
    return rows
