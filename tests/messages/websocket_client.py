# SPDX-License-Identifier: Apache-2.0
"""A small client of a WebSocket (RFC 6455) that speaks Foxglove's protocol, for tests."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
from typing import Any


class FoxgloveClient:
    """Connects and subscribes. Waits at most `timeout_s` for what is to come.

    Attributes:
        channels: what the server has advertised so far, by topic.
    """

    def __init__(self, port: int, timeout_s: float = 5.0, buffer_bytes: int | None = None) -> None:
        self._socket = socket.socket()
        if buffer_bytes is not None:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
        self._socket.settimeout(timeout_s)
        self._socket.connect(("127.0.0.1", port))
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        self._pending = b""
        while b"\r\n\r\n" not in self._pending:
            self._pending += self._socket.recv(4096)
        head, self._pending = self._pending.split(b"\r\n\r\n", 1)
        assert b"101" in head.split(b"\r\n")[0], head
        self.channels: dict[str, dict[str, Any]] = {}
        self._topics: dict[int, str] = {}

    def _exactly(self, size: int) -> bytes:
        while len(self._pending) < size:
            more = self._socket.recv(1 << 16)
            assert more, "the server hung up"
            self._pending += more
        found, self._pending = self._pending[:size], self._pending[size:]
        return found

    def _frame(self) -> tuple[int, bytes]:
        """One message of the server: its opcode and content. Pings are not answered."""
        content, kind = b"", 0
        while True:
            first, second = self._exactly(2)
            size = second & 0x7F
            if size == 126:
                (size,) = struct.unpack(">H", self._exactly(2))
            elif size == 127:
                (size,) = struct.unpack(">Q", self._exactly(8))
            content += self._exactly(size)
            kind = kind or first & 0x0F
            if first & 0x80:
                return kind, content

    def _say(self, words: dict[str, Any]) -> None:
        content, mask = json.dumps(words).encode(), os.urandom(4)
        masked = bytes(byte ^ mask[k % 4] for k, byte in enumerate(content))
        size = bytes([0x80 | len(content)]) if len(content) < 126 else b"\xfe" + struct.pack(">H", len(content))
        self._socket.sendall(b"\x81" + size + mask + masked)

    def subscribe(self, *topics: str) -> None:
        """Waits until the topics are advertised, and subscribes."""
        while not set(topics) <= set(self.channels):
            self._take()
        made = []
        for topic in topics:
            number = len(self._topics) + 1
            self._topics[number] = topic
            made.append({"id": number, "channelId": self.channels[topic]["id"]})
        self._say({"op": "subscribe", "subscriptions": made})

    def _take(self) -> tuple[str, int, bytes] | None:
        kind, content = self._frame()
        if kind == 1:
            words = json.loads(content)
            if words["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in words["channels"]}
        elif kind == 2 and content[0] == 1:
            number, nanoseconds = struct.unpack("<IQ", content[1:13])
            return self._topics[number], nanoseconds, content[13:]
        return None

    def message(self) -> tuple[str, int, bytes]:
        """The next message: topic, log time in nanoseconds, content."""
        while True:
            found = self._take()
            if found is not None:
                return found

    def close(self) -> None:
        self._socket.close()
