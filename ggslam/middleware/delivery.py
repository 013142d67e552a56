# SPDX-License-Identifier: Apache-2.0
"""Hands what came from the network to its taker, so that a slow taker never holds up the network."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Final

from ggslam.middleware.node import Received

log = logging.getLogger(__name__)
CLOSE_S: Final = 2.0
"""Longest wait for a taker that is still busy when its subscription closes."""
NUMBERS_BACK: Final = 1000
"""A number this far behind the last one is not a late message but a writer that began again."""


class Delivery:
    """Messages of a subscription, taken one at a time in a thread of its own. The newest win: where the taker is slow,
    the oldest of `depth` messages makes room and is counted.

    Attributes:
        failures: calls of the taker that raised.
        last_failure: what the last one raised.
    """

    def __init__(self, topic: str, depth: int, take: Callable[[Received], None]) -> None:
        self.topic = topic
        self.failures = 0
        self.last_failure: Exception | None = None
        self._take = take
        self._depth = max(1, depth)
        self._waiting: deque[Received] = deque()
        self._overrun = 0
        self._busy = False
        self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=f"take {topic}", daemon=True)
        self._thread.start()

    def put(self, received: Received) -> None:
        """Adds a message; never waits for the taker."""
        with self._changed:
            if self._closed:
                return
            if len(self._waiting) >= self._depth:
                self._waiting.popleft()
                self._overrun += 1
            self._waiting.append(received)
            self._changed.notify_all()

    @property
    def overrun(self) -> int:
        """Messages that came and had to make room before they were taken."""
        return self._overrun

    def wait_idle(self, timeout_s: float) -> bool:
        """Waits until all messages that came are taken; whether they are."""
        with self._changed:
            return self._changed.wait_for(lambda: self._closed or not (self._waiting or self._busy), timeout_s)

    def close(self) -> None:
        """Takes no more. Waits for the message that is being taken, unless the taker itself closes."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._closed or self._waiting)
                if self._closed:
                    return
                received = self._waiting.popleft()
                self._busy = True
            self._hand_over(received)

    def _hand_over(self, received: Received) -> None:
        try:
            self._take(received)
        except Exception as error:  # of the taker, whatever it is: the next message may be well
            if not self.failures:
                log.exception("%s: a message could not be taken; further ones are only counted", self.topic)
            self.failures += 1
            self.last_failure = error


class Gaps:
    """Counts lost messages by their numbers, writer by writer. A writer that is new may begin at any number."""

    def __init__(self) -> None:
        self.lost = 0
        self._last: dict[str, int] = {}

    def note(self, writer: str, number: int | None) -> bool:
        """Notes a message that came; whether it is new: False for one that came before."""
        if number is None:
            return True
        last = self._last.get(writer)
        if last is not None and last - NUMBERS_BACK < number <= last:
            return False
        if last is not None and number > last:
            self.lost += number - last - 1
        self._last[writer] = number
        return True
