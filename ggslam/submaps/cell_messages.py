# SPDX-License-Identifier: Apache-2.0
"""Messages between a client that sends cells and the server that keeps them, over TCP.

A message is a head (`GGSC`, version, kind, bytes of the body, CRC-32 of the body; little-endian) and a body. The bodies
of HELLO, OK and REFUSED are JSON; that of CELL is the length of a JSON text, that text, and the cell's parts one after
the other, as the text lists them.
"""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
import zlib
from collections.abc import Sequence
from enum import IntEnum
from typing import Any

from ggslam.errors import FormatError
from ggslam.submaps.cell_files import is_part_name
from ggslam.submaps.cell_keys import is_coordinate
from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.index_schema import is_time
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
    """Longest wait for a message, and for all of it from its first byte on, in seconds."""
    slowest_bytes_per_s = 1e5
    """Bytes of a message for each of which more time is given, in bytes/s."""


class Kind(IntEnum):
    """What a message is."""

    HELLO = 1
    CELL = 2
    OK = 3
    REFUSED = 4


_WORDS = {Kind.HELLO: "HELLO first", Kind.CELL: "a cell", Kind.OK: "OK", Kind.REFUSED: "REFUSED"}


def send_message(connection: socket.socket, kind: Kind, body: bytes) -> None:
    """Sends one message. Raises OSError if the other side is gone, or takes it too slowly."""
    connection.settimeout(MessageTuning.timeout_s + len(body) / MessageTuning.slowest_bytes_per_s)
    connection.sendall(_HEAD.pack(_MAGIC, _VERSION, kind, len(body), zlib.crc32(body)) + body)


def send_text(connection: socket.socket, kind: Kind, values: dict[str, Any]) -> None:
    """Sends a message whose body is JSON."""
    send_message(connection, kind, json.dumps(values).encode())


def receive_message(
    connection: socket.socket, expected: Sequence[Kind] = tuple(Kind), wait_s: float | None = None,
    in_all_s: float | None = None, stop: threading.Event | None = None,
) -> tuple[Kind, bytes] | None:
    """The next message, whole and as it was sent; None: the other side ended the connection between two messages.

    Args:
        expected: kinds of message; the body of another one is not read.
        wait_s: seconds to wait for its first byte; None: `MessageTuning.timeout_s`.
        in_all_s: seconds in which it has to be there, waiting included; None: as long as its size may take.
        stop: ends it once set.

    Raises:
        FormatError: not such a message, larger than it may be, or damaged.
        OSError: the connection broke, or the message takes too long.
    """
    wait_s = MessageTuning.timeout_s if wait_s is None else wait_s
    reader = _Reader(connection, wait_s if in_all_s is None else in_all_s, stop)
    first = reader.read(1, may_end=True)
    if first is None:
        return None
    if in_all_s is None:
        reader.until = time.monotonic() + MessageTuning.timeout_s
    kind, length, crc = _kind_of(first + (reader.read(_HEAD.size - 1) or b""), expected)
    if in_all_s is None:
        reader.until += length / MessageTuning.slowest_bytes_per_s
    body = reader.read(length) or b""
    if zlib.crc32(body) != crc:
        raise FormatError("a message was damaged on its way: its checksum is another one")
    return kind, body


def _kind_of(head: bytes, expected: Sequence[Kind]) -> tuple[Kind, int, int]:
    """Kind of a message, bytes and checksum of its body. Raises FormatError if it is none that is taken."""
    magic, version, number, length, crc = _HEAD.unpack(head)
    if magic != _MAGIC:
        raise FormatError(f"expected a message that begins with {_MAGIC!r}, found {magic!r}")
    if version != _VERSION or number not in set(Kind):
        raise FormatError(f"a message of version {version} and kind {number}; this program knows version {_VERSION}")
    kind = Kind(number)
    limit = MessageTuning.max_cell_bytes if kind is Kind.CELL else MessageTuning.max_text_bytes
    if length > limit:
        raise FormatError(f"a message of {length} bytes; at most {limit} are taken")
    if kind not in expected:
        raise FormatError(f"expected {' or '.join(_WORDS[one] for one in expected)}, found {kind.name}")
    return kind, length, crc


class _Reader:
    """Reads from a connection for so many seconds, or until `stop` is set; `until` can be moved."""

    def __init__(self, connection: socket.socket, seconds: float, stop: threading.Event | None) -> None:
        self._connection, self._stop = connection, stop
        self.until = time.monotonic() + seconds

    def read(self, count: int, may_end: bool = False) -> bytes | None:
        """So many bytes; None: the connection ended before the first of them, if it may."""
        data = bytearray()
        while len(data) < count:
            left = self.until - time.monotonic()
            if self._stop is not None and self._stop.is_set():
                raise ConnectionAbortedError("this side ends")
            if left <= 0:
                raise TimeoutError("a message took too long")
            self._connection.settimeout(left)
            piece = self._connection.recv(min(1 << 20, count - len(data)))  # grows with what comes
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
    good = good and is_time(at)
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
