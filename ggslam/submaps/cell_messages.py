# SPDX-License-Identifier: Apache-2.0
"""Messages between a client that sends cells and the server that keeps them, over TCP.

A message is a head (`GGSC`, version, kind, bytes of the body, CRC-32 of the body; little-endian) and a body. The bodies
of HELLO, OK and REFUSED are JSON; that of CELL is the length of a JSON text, that text, and the cell's parts one after
the other, as the text lists them.
"""

from __future__ import annotations

import json
import math
import socket
import struct
import zlib
from enum import IntEnum
from typing import Any

from ggslam.errors import FormatError
from ggslam.submaps.cell_files import is_part_name
from ggslam.submaps.cell_keys import is_coordinate
from ggslam.submaps.cell_records import CellWrite
from ggslam.system.tuning import Tuning

_HEAD = struct.Struct("<4sBBII")
_LENGTH = struct.Struct("<I")
_MAGIC, _VERSION = b"GGSC", 1


class MessageTuning(Tuning):
    """Limits of messages."""

    max_cell_bytes = 1 << 28
    """Largest body of a cell, in bytes."""
    max_text_bytes = 1 << 16
    """Largest body of another message, in bytes."""
    timeout_s = 30.0
    """Longest silence within a connection, in seconds."""


class Kind(IntEnum):
    """What a message is."""

    HELLO = 1
    CELL = 2
    OK = 3
    REFUSED = 4


def send_message(connection: socket.socket, kind: Kind, body: bytes) -> None:
    """Sends one message. Raises OSError if the other side is gone."""
    connection.sendall(_HEAD.pack(_MAGIC, _VERSION, kind, len(body), zlib.crc32(body)) + body)


def send_text(connection: socket.socket, kind: Kind, values: dict[str, Any]) -> None:
    """Sends a message whose body is JSON."""
    send_message(connection, kind, json.dumps(values).encode())


def receive_message(connection: socket.socket) -> tuple[Kind, bytes] | None:
    """The next message, whole and as it was sent; None: the other side ended the connection between two messages.

    Raises:
        FormatError: not such a message, larger than it may be, or damaged.
        OSError: the connection broke or was silent for too long.
    """
    head = _receive(connection, _HEAD.size, may_end=True)
    if head is None:
        return None
    magic, version, number, length, crc = _HEAD.unpack(head)
    if magic != _MAGIC:
        raise FormatError(f"expected a message that begins with {_MAGIC!r}, found {magic!r}")
    if version != _VERSION or number not in set(Kind):
        raise FormatError(f"a message of version {version} and kind {number}; this program knows version {_VERSION}")
    kind = Kind(number)
    limit = MessageTuning.max_cell_bytes if kind is Kind.CELL else MessageTuning.max_text_bytes
    if length > limit:
        raise FormatError(f"a message of {length} bytes; at most {limit} are taken")
    body = _receive(connection, length) or b""
    if zlib.crc32(body) != crc:
        raise FormatError("a message was damaged on its way: its checksum is another one")
    return kind, body


def _receive(connection: socket.socket, count: int, may_end: bool = False) -> bytes | None:
    data = bytearray()
    while len(data) < count:
        piece = connection.recv(min(1 << 20, count - len(data)))  # grows with what comes, not with what is announced
        if not piece:
            if may_end and not data:
                return None
            raise ConnectionError("the connection ended within a message")
        data += piece
    return bytes(data)


def read_text(body: bytes) -> dict[str, Any]:
    """The body of a message that is JSON. Raises FormatError if it is no JSON object."""
    try:
        values = json.loads(body.decode())
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, dict):
        raise FormatError("a message whose text is no JSON object")
    return values


def cell_to_body(write: CellWrite, visit: str) -> bytes:
    """The body of a cell of a visit."""
    parts = [[name, len(data), write.counts.get(name, 0)] for name, data in write.parts.items()]
    values = {"key": list(write.key), "visit": visit, "recorded_at": write.recorded_at, "parts": parts}
    text = json.dumps(values).encode()
    return b"".join([_LENGTH.pack(len(text)), text, *write.parts.values()])


def cell_of_body(body: bytes) -> tuple[CellWrite, str]:
    """A cell and its visit.

    Raises:
        FormatError: the body is not one of a cell.
    """
    length = _LENGTH.unpack_from(body)[0] if len(body) >= _LENGTH.size else 0
    values = read_text(body[_LENGTH.size : _LENGTH.size + length])
    key, visit, at, listed = (values.get(name) for name in ("key", "visit", "recorded_at", "parts"))
    good = isinstance(key, list) and len(key) == 3 and all(map(is_coordinate, key))
    good = good and isinstance(visit, str) and 0 < len(visit) <= 200 and visit.isprintable()
    good = good and (at is None or (type(at) in (int, float) and math.isfinite(at)))
    good = good and isinstance(listed, list) and all(_is_listed(part) for part in listed)
    if not good or not listed or not isinstance(key, list) or not isinstance(visit, str):
        raise FormatError("a message that is no cell: expected key, visit, recorded_at and parts")
    place, parts, counts = _LENGTH.size + length, dict[str, bytes](), dict[str, int]()
    for name, size, count in listed:
        parts[name], counts[name] = body[place : place + size], count
        place += size
    if place != len(body) or len(parts) != len(listed):
        raise FormatError(f"a cell whose parts have {place} bytes in a message of {len(body)}")
    x, y, z = key
    return CellWrite((x, y, z), parts, at, counts), visit


def _is_listed(part: Any) -> bool:
    """Whether it is [name, bytes, count]."""
    if not (isinstance(part, list) and len(part) == 3 and isinstance(part[0], str) and is_part_name(part[0])):
        return False
    return all(type(number) is int and 0 <= number < 1 << 31 for number in part[1:])
