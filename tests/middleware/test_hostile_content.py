# SPDX-License-Identifier: Apache-2.0
"""Content that came over the network may be anything: it decodes, or it is refused."""

from __future__ import annotations

import random
import struct
import time
import tracemalloc
from typing import Any

import numpy as np
import pytest

from ggslam.errors import MiddlewareError
from ggslam.middleware.types import MessageTypes, message_types

pytest.importorskip("rosbags")
MUTATIONS = 2000
KINDS = ("Image", "CameraInfo", "TFMessage", "CompressedImage", "PointCloud2")


def header(types: MessageTypes) -> Any:
    stamp = types.make("builtin_interfaces/msg/Time", sec=1, nanosec=2)
    return types.make("std_msgs/msg/Header", stamp=stamp, frame_id="camera")


def some(types: MessageTypes, name: str) -> tuple[str, bytes]:
    """A small message of each kind."""
    make, numbers, head = types.make, np.arange(60, dtype=np.uint8), header(types)
    if name == "Image":
        fields: dict[str, Any] = {"height": 4, "width": 5, "encoding": "rgb8", "is_bigendian": 0, "step": 15}
        kind, fields = "sensor_msgs/msg/Image", fields | {"data": numbers}
    elif name == "CameraInfo":
        roi = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        kind = "sensor_msgs/msg/CameraInfo"
        fields = {"height": 4, "width": 5, "distortion_model": "plumb_bob", "d": np.zeros(5), "k": np.zeros(9),
                  "r": np.zeros(9), "p": np.zeros(12), "binning_x": 0, "binning_y": 0, "roi": roi}  # fmt: skip
    elif name == "TFMessage":
        vector = make("geometry_msgs/msg/Vector3", x=1.0, y=2.0, z=3.0)
        turn = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        transform = make("geometry_msgs/msg/Transform", translation=vector, rotation=turn)
        stamped = make(
            "geometry_msgs/msg/TransformStamped", header=head, child_frame_id="base", transform=transform
        )
        kind = "tf2_msgs/msg/TFMessage"
        return kind, types.encode(kind, make(kind, transforms=[stamped] * 3))
    elif name == "CompressedImage":
        kind, fields = "sensor_msgs/msg/CompressedImage", {"format": "jpeg", "data": numbers}
    else:
        parts = [make("sensor_msgs/msg/PointField", name=n, offset=4 * i, datatype=7, count=1)
                 for i, n in enumerate("xyz")]  # fmt: skip
        kind = "sensor_msgs/msg/PointCloud2"
        fields = {"height": 1, "width": 5, "fields": parts, "is_bigendian": False, "point_step": 12,
                  "row_step": 60, "data": numbers, "is_dense": True}  # fmt: skip
    return kind, types.encode(kind, make(kind, header=head, **fields))


def mutate(content: bytes, draw: random.Random) -> bytes:
    """Bits, words such as lengths, cuts, additions, and bytes of nobody."""
    changed = bytearray(content)
    for _ in range(draw.randint(1, 4)):
        what, place = draw.randrange(6), draw.randrange(len(changed)) if changed else 0
        if what == 0 and changed:
            changed[place] ^= 1 << draw.randrange(8)
        elif what == 1:
            word = draw.choice((0xFFFFFFFF, 0x7FFFFFFF, 0x80000000, 1 << 28, draw.getrandbits(32), 0))
            struct.pack_into("<I", changed, max(0, min(place & ~3, len(changed) - 4)), word) if len(changed) > 4 else 0
        elif what == 2:
            del changed[place:]
        elif what == 3:
            changed += draw.randbytes(draw.randrange(40))
        elif what == 4 and changed:
            changed[place : place + 8] = draw.randbytes(8)
        elif what == 5 and not draw.randrange(20):
            changed = bytearray(draw.randbytes(draw.randrange(200)))
    return bytes(changed)


@pytest.mark.parametrize("name", KINDS)
def test_mutated_messages_decode_or_are_refused(name: str) -> None:
    types = message_types("jazzy")
    kind, content = some(types, name)
    assert types.decode(kind, content) is not None
    draw, refused, longest = random.Random(name), 0, 0.0
    tracemalloc.start()
    for _ in range(MUTATIONS):
        mutated = mutate(content, draw)
        began = time.process_time()
        try:
            types.decode(kind, mutated)
        except MiddlewareError as error:
            refused += 1
            assert kind in str(error)
        longest = max(longest, time.process_time() - began)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert MUTATIONS // 10 < refused < MUTATIONS
    assert longest < 0.5 and peak < 50e6


@pytest.mark.parametrize("length", [0xFFFFFFFF, 0x80000000, 1 << 28])
def test_lengths_of_billions_are_refused_at_once(length: int) -> None:
    types = message_types("jazzy")
    kind, content = some(types, "TFMessage")
    cases = [(kind, content[:4] + struct.pack("<I", length) + content[8:])]
    for name in ("Image", "CompressedImage"):
        kind, content = some(types, name)
        place = content.rindex(struct.pack("<I", 60))
        cases.append((kind, content[:place] + struct.pack("<I", length) + content[place + 4 :]))
    tracemalloc.start()
    for kind, content in cases:
        began = time.process_time()
        with pytest.raises(MiddlewareError, match=kind):
            types.decode(kind, content)
        assert time.process_time() - began < 0.2
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


def test_nested_empty_elements_are_refused() -> None:
    """Elements of one byte: the message is as long as its count says, or it is refused."""
    types = MessageTypes("jazzy")
    types.register({"x_msgs/msg/Many": "std_msgs/Empty[] empties\n", "x_msgs/msg/Texts": "string[] texts\n"})
    for kind in ("x_msgs/msg/Many", "x_msgs/msg/Texts"):
        began = time.process_time()
        with pytest.raises(MiddlewareError):
            types.decode(kind, b"\0\1\0\0\xff\xff\xff\xff" + bytes(100))
        assert time.process_time() - began < 0.2
