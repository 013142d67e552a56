# SPDX-License-Identifier: Apache-2.0
"""Seconds by part of a merge."""

from __future__ import annotations

import time


class Clock:
    """Counts from when it is made."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, part: str) -> None:
        """What passed since the last one was this part."""
        now = time.perf_counter()
        self.seconds[part] = self.seconds.get(part, 0.0) + now - self._last
        self._last = now
