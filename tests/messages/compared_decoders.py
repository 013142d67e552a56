# SPDX-License-Identifier: Apache-2.0
"""Messages of files, read by several decoders that know nothing of one another."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from second_readers import numbers_of, read_protobuf, stamp_ns

from ggslam.middleware.dds_types import RawTypes
from ggslam.middleware.types import message_types

LARGEST_DDS = 100_000
"""Bytes of a message that Cyclone DDS reads: it goes through arrays number by number."""


@dataclass
class Compared:
    """Messages that decoders agree about, by decoder, and where they differ from the first."""

    read: Counter[str] = field(default_factory=Counter)
    differences: list[str] = field(default_factory=list)


def differences(ours: Any, theirs: Any, place: str = "") -> list[str]:
    """Where a message of rosbags and another decoder's differ; numbers must be the same bit for bit."""
    if hasattr(ours, "__msgtype__"):
        found = []
        for name, _ in message_types("jazzy").fields(ours.__msgtype__):  # constants are attributes, too
            found += differences(getattr(ours, name), getattr(theirs, name), f"{place}.{name}")
        return found
    if isinstance(ours, np.ndarray):
        raw = isinstance(theirs, bytes | bytearray | memoryview)
        other = np.frombuffer(theirs, ours.dtype) if raw else np.asarray(theirs, ours.dtype)
        return [] if ours.tobytes() == other.tobytes() else [place]
    if isinstance(ours, list):
        if len(ours) != len(theirs):
            return [f"{place}: {len(ours)} and {len(theirs)}"]
        return [text for k, pair in enumerate(zip(ours, theirs, strict=True))
                for text in differences(*pair, f"{place}[{k}]")]  # fmt: skip
    return [] if ours == theirs or (ours != ours and theirs != theirs) else [f"{place}: {ours!r} and {theirs!r}"]


def read_recorded(path: Path) -> Iterator[tuple[str, str, float, bytes, Any]]:
    """Topic, type, time of arrival, CDR, and the message as mcap-ros2-support reads it."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as file:
        for one in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            assert one.schema is not None
            yield one.channel.topic, one.schema.name, 1e-9 * one.message.log_time, one.message.data, one.decoded_message


def compare_recorded(path: Path) -> Compared:
    """Every message of ROS 2 in a file, by rosbags, by mcap-ros2-support and, where it is small, by Cyclone DDS."""
    types, found = message_types("jazzy"), Compared()
    structs = RawTypes(types)
    for topic, kind, _, content, theirs in read_recorded(path):
        ours = types.decode(kind, content)
        readings = {"mcap-ros2-support": theirs}
        if len(content) < LARGEST_DDS:
            readings["cyclonedds"] = structs._struct(kind).deserialize(content)  # type: ignore[attr-defined]
        for decoder, reading in readings.items():
            wrong = differences(ours, reading)
            found.read[decoder] += 1
            found.differences += [f"{topic} by {decoder}: {wrong[0]}"] if wrong else []
    return found


Located = dict[tuple[str, int], list[np.ndarray]]
"""By frame and nanoseconds, each x y z and quaternion x y z w that was told: the last one is corrected at the end."""


def located_ros2(path: Path) -> Located:
    """Poses and edges of frames of a file of ROS 2, in the order in which they came."""
    found: Located = {}
    for topic, _, _, _, message in read_recorded(path):
        if topic == "/ggslam/pose":
            found.setdefault(("pose", stamp_ns(message.header.stamp)), []).append(numbers_of(message.pose))
        elif topic == "/tf":
            for edge in message.transforms:
                t, q = edge.transform.translation, edge.transform.rotation
                key = edge.child_frame_id, stamp_ns(edge.header.stamp)
                found.setdefault(key, []).append(np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w]))
    return found


def compare_foxglove(path: Path, ros2: Located) -> Compared:
    """Every message of an MCAP of Foxglove, by protobuf with the schemas in the file: no field that the schemas do not
    have; poses and frames as ROS 2 was told them."""
    from google.protobuf.unknown_fields import UnknownFieldSet
    from mcap.reader import make_reader

    found = Compared()
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if schema is None or schema.encoding != "protobuf":
                continue
            read = read_protobuf(schema, message.data)
            found.read["protobuf"] += 1
            if len(UnknownFieldSet(read)):
                found.differences.append(f"{channel.topic}: a field that its schema does not have")
            for key, numbers in _located(channel.topic, read):
                if key in ros2:
                    found.read["as ROS 2"] += 1
                    if not any(np.array_equal(numbers, told) for told in ros2[key]):
                        found.differences.append(f"{channel.topic}, {key}: {numbers} and {ros2[key]}")
    return found


def _located(topic: str, read: Any) -> Iterator[tuple[tuple[str, int], np.ndarray]]:
    if topic == "/ggslam/pose":
        yield ("pose", stamp_ns(read.timestamp)), numbers_of(read.pose)
    elif topic == "/tf":
        for edge in read.transforms:
            t, q = edge.translation, edge.rotation
            yield (edge.child_frame_id, stamp_ns(edge.timestamp)), np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w])
