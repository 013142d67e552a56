# SPDX-License-Identifier: Apache-2.0
"""Which work on the pretended device precedes which: streams, events, and what the host has waited for."""

from __future__ import annotations

import threading
from collections import defaultdict
from dataclasses import dataclass

from device_watch.records import UnorderedWork, here

Clock = dict[int, int]
"""Of each stream, how many pieces of its work are done."""


@dataclass(frozen=True)
class _Access:
    """The last one of a stream to some memory."""

    time: int
    written: int  # when the stream last wrote there
    what: str


def _join(clock: Clock, other: Clock) -> None:
    for stream, time in other.items():
        clock[stream] = max(time, clock.get(stream, 0))


class WorkOrder:
    """Clocks of streams. Raises UnorderedWork where two streams use the same memory, one of them to write, and neither
    is sure to be first."""

    def __init__(self) -> None:
        self._clocks: defaultdict[int, Clock] = defaultdict(dict)
        self._host: Clock = {}
        self._accesses: defaultdict[int, dict[int, _Access]] = defaultdict(dict)
        self._streams = threading.local()
        self._lock = threading.Lock()

    # --- streams -----------------------------------------------------------------------------------------------------

    @property
    def stream(self) -> int:
        """That this thread works on; 0: the one of all threads."""
        stack: list[int] = getattr(self._streams, "stack", [])
        return stack[-1] if stack else 0

    def enter(self, stream: int) -> None:
        """From now on this thread works on a stream."""
        self._streams.stack = [*getattr(self._streams, "stack", []), stream]

    def leave(self) -> None:
        """It works on the one before again."""
        self._streams.stack = self._streams.stack[:-1]

    def now(self, stream: int) -> Clock:
        """What is done when all is done that was started on a stream."""
        with self._lock:
            return dict(self._clocks[stream])

    def wait(self, stream: int, clock: Clock) -> None:
        """What is started on a stream from now on waits for that."""
        with self._lock:
            _join(self._clocks[stream], clock)

    def host_waits(self, clock: Clock | None = None) -> None:
        """The host has waited for that, with all of its threads; None: for what this thread's stream was given."""
        with self._lock:
            _join(self._host, self._clocks[self.stream] if clock is None else clock)

    def is_known(self, clock: Clock) -> bool:
        """Whether the host has waited for that."""
        with self._lock:
            return all(self._host.get(stream, 0) >= time for stream, time in clock.items())

    # --- work --------------------------------------------------------------------------------------------------------

    def start(self, what: str, reads: set[int], writes: set[int]) -> None:
        """A piece of work on this thread's stream; memory by its address.

        Raises:
            UnorderedWork: see there.
        """
        stream = self.stream
        with self._lock:
            clock = self._clocks[stream]
            _join(clock, self._host)
            clock[stream] = clock.get(stream, 0) + 1
            text = f"{what} ({here()})"
            for address in reads | writes:
                self._touch(address, stream, clock, address in writes, text)

    def forget(self, address: int) -> None:
        """Nobody has the memory any more."""
        self._accesses.pop(address, None)

    def _touch(self, address: int, stream: int, clock: Clock, writes: bool, what: str) -> None:
        accesses = self._accesses[address]
        for other, access in accesses.items():
            if other != stream and clock.get(other, 0) < (access.time if writes else access.written):
                both = f"{what} on stream {stream} and {access.what} on stream {other}"
                raise UnorderedWork(f"{both} use the same memory")
        time = clock[stream]
        before = accesses.get(stream)
        written = time if writes else 0 if before is None else before.written
        accesses[stream] = _Access(time, written, what)
