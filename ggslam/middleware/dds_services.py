# SPDX-License-Identifier: Apache-2.0
"""Services on DDS, as rmw_cyclonedds_cpp has them: a topic of requests and one of replies. In front of each stand 16
bytes, the client's id and the number of the request, that the reply brings back."""

from __future__ import annotations

import queue
import secrets
import struct
import threading
import time
from typing import Any, Final

from ggslam.errors import MiddlewareError
from ggslam.middleware.dds_domain import delete
from ggslam.middleware.dds_topics import Reading
from ggslam.middleware.services import Answers

CDR_BYTES: Final = 4
HEADER_BYTES: Final = 16
LITTLE: Final = b"\0\1\0\0"
MATCH_S: Final = 0.1
"""Longest wait of a service for the client's reader, which may be found after its request came."""
LOOK_S: Final = 0.01


def request_header(content: bytes) -> tuple[int, int] | None:
    """(client, number) of a request or reply; None: it is too short."""
    if len(content) < CDR_BYTES + HEADER_BYTES:
        return None
    client, number = struct.unpack_from("<Qq" if content[1] & 1 else ">Qq", content, CDR_BYTES)
    return client, number


def with_header(client: int, number: int, content: bytes) -> bytes:
    """CDR, little-endian, with the header of a service in front of its payload."""
    return content[:CDR_BYTES] + struct.pack("<Qq", client, number) + content[CDR_BYTES:]


def without_header(content: bytes) -> bytes:
    """CDR of the payload alone: 16 bytes do not change how anything behind them is aligned."""
    return content[:CDR_BYTES] + content[CDR_BYTES + HEADER_BYTES :]


class DdsOffered:
    """A service that a node offers."""

    def __init__(self, reader: Any, writer: Any, raw: type, reading: Reading, answers: Answers) -> None:
        self._reader, self._writer, self._raw = reader, writer, raw
        self._reading, self._answers = reading, answers
        self._lock = threading.Lock()
        self._closed = False
        self._condition = reading.add(reader, lambda sample: answers.put(lambda: self._answer(sample)))

    def _answer(self, sample: Any) -> None:
        header = request_header(sample.content)
        if header is None:
            self._answers.refuse("a request is not as rmw_cyclonedds_cpp sends it")
            return
        response = self._answers.response(without_header(sample.content))
        if response is None:
            return
        self._wait_for_client(sample.sample_info.publication_handle)
        with self._lock:
            if not self._closed:
                self._writer.write(self._raw(with_header(*header, response)))

    def _wait_for_client(self, handle: int) -> None:
        """Waits until a reader of the process that asked is known."""
        deadline = time.monotonic() + MATCH_S
        while time.monotonic() < deadline:
            with self._lock:
                if self._closed:
                    return
                asked = self._reader.get_matched_publication_data(handle)
                if asked is None:
                    return
                found = [self._writer.get_matched_subscription_data(h) for h in self._writer.matched_sub]
            if any(reader and reader.participant_key == asked.participant_key for reader in found):
                return
            time.sleep(LOOK_S)

    def close(self) -> None:
        """Offers it no more."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        self._answers.close()
        self._reading.remove(self._condition)
        delete(self._writer)


class DdsClient:
    """Calls a service."""

    def __init__(self, name: str, reader: Any, writer: Any, raw: type, reading: Reading) -> None:
        self.name = name
        self._reader, self._writer, self._raw, self._reading = reader, writer, raw, reading
        self._id = secrets.randbits(64)
        self._lock = threading.Lock()
        self._number = 0
        self._waiting: dict[int, queue.SimpleQueue[bytes]] = {}
        self._condition = reading.add(reader, self._take)

    def call(self, content: bytes, timeout_s: float) -> bytes:
        """The response to a request, both as CDR; raises MiddlewareError where none comes in time."""
        deadline = time.monotonic() + timeout_s
        late = MiddlewareError(f"`{self.name}`: nobody answered in {timeout_s:g} s")
        while not (self._writer.matched_sub and self._reader.get_matched_publications()):
            if time.monotonic() > deadline:
                raise late
            time.sleep(LOOK_S)
        came: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        with self._lock:
            self._number += 1
            number = self._number
            self._waiting[number] = came
        try:
            self._writer.write(self._raw(with_header(self._id, number, content)))
            return came.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            raise late from None
        finally:
            with self._lock:
                self._waiting.pop(number, None)

    def _take(self, sample: Any) -> None:
        header = request_header(sample.content)
        if header is not None and header[0] == self._id:
            with self._lock:
                came = self._waiting.get(header[1])
            if came is not None:
                came.put(without_header(sample.content))

    def close(self) -> None:
        """Calls no more."""
        self._reading.remove(self._condition)
        delete(self._writer)
