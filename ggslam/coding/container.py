# SPDX-License-Identifier: Apache-2.0
"""The stream of units (ISO/IEC 23090-9, first edition): type (1 byte), length (4 bytes, big-endian), payload."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

from ggslam.errors import FormatError


class UnitType(IntEnum):
    """What a unit holds."""

    SEQUENCE_PARAMETERS = 0
    GEOMETRY_PARAMETERS = 1
    GEOMETRY = 2
    ATTRIBUTE_PARAMETERS = 3
    ATTRIBUTE = 4
    TILE_INVENTORY = 5
    FRAME_BOUNDARY = 6
    CONSTANT_ATTRIBUTE = 7
    ATTRIBUTE_PARAMETER_INVENTORY = 8
    USER_DATA = 9

    @property
    def title(self) -> str:
        """The name in messages and listings."""
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True)
class Unit:
    """One unit. `offset` is the place of its first byte in the stream."""

    kind: UnitType
    payload: memoryview
    offset: int = 0

    @property
    def size(self) -> int:
        """Bytes in the stream, header included."""
        return HEADER.size + len(self.payload)


HEADER = struct.Struct(">BI")


def unit_bytes(kind: UnitType, payload: bytes) -> bytes:
    """One unit as it stands in a stream."""
    return HEADER.pack(kind, len(payload)) + payload


def read_units(data: bytes | memoryview) -> Iterator[Unit]:
    """The units of a stream, in order; payloads are views, not copies.

    Raises:
        FormatError: a unit of unknown type or one that ends after the stream does.
    """
    view = memoryview(data).cast("B")
    at = 0
    while at < len(view):
        if at + HEADER.size > len(view):
            raise FormatError(f"the stream ends within the header of a unit, at byte {at}")
        kind, length = HEADER.unpack_from(view, at)
        if kind not in set(UnitType):
            raise FormatError(f"byte {at} starts no unit of a G-PCC stream (type {kind})")
        end = at + HEADER.size + length
        if end > len(view):
            left = len(view) - at - HEADER.size
            raise FormatError(f"the {UnitType(kind).title} unit at byte {at} says {length} bytes, {left} are left")
        yield Unit(UnitType(kind), view[at + HEADER.size : end], at)
        at = end
