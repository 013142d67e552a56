# SPDX-License-Identifier: Apache-2.0
"""Notices that somebody began to listen, where the middleware only tells how many do."""

from __future__ import annotations

import threading
from collections.abc import Callable

from ggslam.messages.contents import Channel
from ggslam.system.tuning import Tuning


class JoinTuning(Tuning):
    """How joins are noticed."""

    every_s = 0.25
    """Seconds between two looks."""
    longest_s = 2.0
    """Seconds that the end waits for a look, which may wait for who ends it."""


class JoinWatch:
    """Looks at numbers of listeners again and again, in a thread of its own; tells when one grew. A listener that
    comes between two looks while another one goes is not noticed."""

    def __init__(self) -> None:
        self._counts: dict[Channel, tuple[Callable[[], int], int]] = {}
        self._told: list[Callable[[Channel], None]] = []
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def add(self, channel: Channel, count: Callable[[], int]) -> None:
        """Watches a channel from now on."""
        with self._lock:
            self._counts[channel] = (count, 0)

    def tell(self, told: Callable[[Channel], None]) -> None:
        """Begins to tell."""
        with self._lock:
            self._told.append(told)
            if self._thread is None:
                self._thread = threading.Thread(target=self._look, name="joins", daemon=True)
                self._thread.start()

    def _look(self) -> None:
        while not self._ended.wait(JoinTuning.every_s):
            with self._lock:
                told = list(self._told)
                grown = []
                for channel, (count, before) in self._counts.items():
                    now = count()
                    self._counts[channel] = (count, now)
                    if now > before:
                        grown.append(channel)
            for channel in grown:
                for tell in told:
                    tell(channel)

    def close(self) -> None:
        """Ends the thread."""
        self._ended.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(JoinTuning.longest_s)
