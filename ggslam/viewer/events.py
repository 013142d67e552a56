# SPDX-License-Identifier: Apache-2.0
"""News for pages, as Server-Sent Events. A page that reads slowly gets the latest, not all: nothing piles up."""

from __future__ import annotations

import json
import threading
from typing import Any

from ggslam.system.tuning import Tuning


class EventTuning(Tuning):
    """How pages are told."""

    heartbeat_s = 10.0
    """Seconds after which a page is told that the program is still there."""


class Listener:
    """One page that listens: what it has not heard yet, later news in place of earlier ones."""

    def __init__(self) -> None:
        self._given = threading.Condition()
        self._what: set[str] = set()
        self._values: dict[str, Any] = {}
        self._ended = False

    def tell(self, what: list[str], values: dict[str, Any]) -> None:
        """Notes news."""
        with self._given:
            self._what |= set(what)
            self._values |= values
            self._given.notify()

    def end(self) -> None:
        """No more will come."""
        with self._given:
            self._ended = True
            self._given.notify()

    def next(self) -> bytes | None:
        """The next event, waited for; a heartbeat if there is none; None: no more will come."""
        with self._given:
            self._given.wait_for(lambda: self._what or self._ended, EventTuning.heartbeat_s)
            if self._ended:
                return None
            if not self._what:
                return b": still here\n\n"
            news = {"what": sorted(self._what), **self._values}
            self._what, self._values = set(), {}
        return f"data: {json.dumps(news)}\n\n".encode()


class Events:
    """Who listens."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._listeners: set[Listener] = set()

    def __len__(self) -> int:
        return len(self._listeners)

    def join(self) -> Listener:
        """A new listener."""
        listener = Listener()
        with self._lock:
            self._listeners.add(listener)
        return listener

    def leave(self, listener: Listener) -> None:
        """It listens no more."""
        with self._lock:
            self._listeners.discard(listener)

    def tell(self, *what: str, **values: Any) -> None:
        """Tells all pages what changed: "scene", "splats", "camera", "text"."""
        with self._lock:
            listeners = list(self._listeners)
        for listener in listeners:
            listener.tell(list(what), values)

    def end(self) -> None:
        """Ends them all."""
        with self._lock:
            listeners = list(self._listeners)
        for listener in listeners:
            listener.end()
