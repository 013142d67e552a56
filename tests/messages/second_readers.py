# SPDX-License-Identifier: Apache-2.0
"""Decoders of others: ROS 2's messages by mcap-ros2-support, from an MCAP with their definitions; Foxglove's by
protobuf, from the schemas that a file brings."""

from __future__ import annotations

import io
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

LINE = "=" * 80
OTHERS = {
    "map_msgs/msg/OccupancyGridUpdate": ("""std_msgs/Header header
int32 x
int32 y
uint32 width
uint32 height
int8[] data
""", ("std_msgs/msg/Header",)),
    "vision_msgs/msg/Detection3DArray": (f"""std_msgs/Header header
vision_msgs/Detection3D[] detections
{LINE}
MSG: vision_msgs/Detection3D
std_msgs/Header header
vision_msgs/ObjectHypothesisWithPose[] results
vision_msgs/BoundingBox3D bbox
string id
{LINE}
MSG: vision_msgs/ObjectHypothesisWithPose
vision_msgs/ObjectHypothesis hypothesis
geometry_msgs/PoseWithCovariance pose
{LINE}
MSG: vision_msgs/ObjectHypothesis
string class_id
float64 score
{LINE}
MSG: vision_msgs/BoundingBox3D
geometry_msgs/Pose center
geometry_msgs/Vector3 size
""", ("std_msgs/msg/Header", "geometry_msgs/msg/PoseWithCovariance", "geometry_msgs/msg/Vector3")),
}  # fmt: skip
"""Definitions as map_msgs and vision_msgs 4 publish them, and the types of the distribution that they are made of."""


@cache
def definition(kind: str, distribution: str = "jazzy") -> bytes:
    """The definition of a type of ROS 2, with those that it is made of."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores[f"ROS2_{distribution.upper()}"])
    if kind not in OTHERS:
        return store.generate_msgdef(kind, ros_version=2)[0].encode()
    text, parts = OTHERS[kind]
    for part in parts:
        text += f"{LINE}\nMSG: {part.replace('/msg/', '/')}\n{store.generate_msgdef(part, ros_version=2)[0]}"
    return text.encode()


def read_ros2(kind: str, content: bytes, distribution: str = "jazzy") -> Any:
    """A message of ROS 2 in CDR, decoded by mcap-ros2-support from an MCAP."""
    from mcap.reader import make_reader
    from mcap.writer import Writer
    from mcap_ros2.decoder import DecoderFactory

    file = io.BytesIO()
    writer = Writer(file)
    writer.start(profile="ros2")
    schema = writer.register_schema(kind, "ros2msg", definition(kind, distribution))
    writer.add_message(writer.register_channel("/topic", "cdr", schema), 1, content, 1)
    writer.finish()
    file.seek(0)
    (found,) = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
    return found.decoded_message


def read_foxglove(path: Path) -> dict[str, list[Any]]:
    """Messages of an MCAP by topic; protobuf by the descriptors in the file, JSON as dicts."""
    from mcap.reader import make_reader

    found: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            read = json.loads(message.data) if schema.encoding == "jsonschema" else read_protobuf(schema, message.data)
            found.setdefault(channel.topic, []).append(read)
    return found


def read_protobuf(schema: Any, content: bytes) -> Any:
    """A message by the descriptors of its schema."""
    return _message_class(schema.name, bytes(schema.data)).FromString(content)


@cache
def _message_class(name: str, descriptors: bytes) -> Any:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def numbers_of(pose: Any) -> np.ndarray:
    """x y z and quaternion x y z w of a pose of either."""
    p, q = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


def stamp_ns(stamp: Any) -> int:
    """Nanoseconds of a stamp of either."""
    seconds = stamp.sec if hasattr(stamp, "sec") else stamp.seconds
    return int(seconds) * 10**9 + int(stamp.nanosec if hasattr(stamp, "nanosec") else stamp.nanos)


ROS_NUMBERS = {2: "u1", 4: "<u2", 6: "<u4", 7: "<f4"}
FOXGLOVE_NUMBERS = {1: "u1", 2: "i1", 3: "<u2", 7: "<f4"}


def cloud_table(message: Any) -> np.ndarray:
    """A cloud of either as a table."""
    ros = hasattr(message, "point_step")
    numbers = [ROS_NUMBERS[f.datatype] if ros else FOXGLOVE_NUMBERS[f.type] for f in message.fields]
    kind = {
        "names": [f.name for f in message.fields], "formats": numbers, "offsets": [f.offset for f in message.fields],
        "itemsize": message.point_step if ros else message.point_stride,
    }  # fmt: skip
    return np.frombuffer(bytes(message.data), np.dtype(kind))  # type: ignore[call-overload]
