# SPDX-License-Identifier: Apache-2.0
"""Writes repeated messages of protobuf by the thousand: messages whose fields are all doubles have one size, so an
array of a packed type is their wire format. A field of zero, which others leave out, may be there."""

from __future__ import annotations

from typing import Final

import numpy as np

DOUBLE, BYTES = 1, 2
"""Wire types."""
POINT_FIELDS: Final = (("x", 1), ("y", 2), ("z", 3))
COLOR_FIELDS: Final = (("r", 1), ("g", 2), ("b", 3), ("a", 4))
QUATERNION_FIELDS: Final = (("x", 1), ("y", 2), ("z", 3), ("w", 4))


def tag(number: int, wire: int) -> int:
    """The byte before a field with a number below 16."""
    return number << 3 | wire


def length(size: int) -> bytes:
    """A varint."""
    found = bytearray()
    while size > 0x7F:
        found.append(size & 0x7F | 0x80)
        size >>= 7
    return bytes([*found, size])


def field(number: int, content: bytes) -> bytes:
    """A field of bytes, a text or a message."""
    return bytes([tag(number, BYTES)]) + length(len(content)) + content


def double_rows(number: int, values: np.ndarray, fields: tuple[tuple[str, int], ...]) -> bytes:
    """A repeated message of doubles: rows float [n, fields]."""
    kind: list[tuple[str, str]] = [("tag", "u1"), ("length", "u1")]
    for name, _ in fields:
        kind += [(f"{name}_tag", "u1"), (name, "<f8")]
    rows = np.empty(len(values), np.dtype(kind))
    rows["tag"], rows["length"] = tag(number, BYTES), 9 * len(fields)
    for k, (name, inner) in enumerate(fields):
        rows[f"{name}_tag"], rows[name] = tag(inner, DOUBLE), values[:, k]
    return rows.tobytes()


def pose_rows(number: int, numbers: np.ndarray) -> bytes:
    """A repeated foxglove.Pose: x y z and quaternion x y z w, float [n, 7]."""
    parts = [_single_rows(double_rows(1, numbers[:, :3], POINT_FIELDS), len(numbers)),
             _single_rows(double_rows(2, numbers[:, 3:], QUATERNION_FIELDS), len(numbers))]  # fmt: skip
    inner = np.concatenate(parts, 1)
    head = np.tile(np.array([tag(number, BYTES), inner.shape[1]], np.uint8), (len(numbers), 1))
    return np.concatenate([head, inner], 1).tobytes()


def _single_rows(content: bytes, count: int) -> np.ndarray:
    """Messages of one size as rows of bytes."""
    return np.frombuffer(content, np.uint8).reshape(count, -1 if count else 0)


def packed_uint32(number: int, values: np.ndarray) -> bytes:
    """A repeated fixed32."""
    return field(number, np.ascontiguousarray(values, "<u4").tobytes())
