# SPDX-License-Identifier: Apache-2.0
"""Seconds that the parts of a merge take."""

from __future__ import annotations

import time


class Clock:
    """Counts seconds from its creation."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, part: str) -> None:
        """What passed since the last one was this part."""
        now = time.perf_counter()
        self.seconds[part] = self.seconds.get(part, 0.0) + now - self._last
        self._last = now
