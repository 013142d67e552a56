# SPDX-License-Identifier: Apache-2.0
"""From a limit of resident memory to bytes that a map may take."""

from __future__ import annotations

from dataclasses import dataclass

from ggslam.errors import ConfigError
from ggslam.system.process_memory import peak_memory_bytes, release_early, resident_bytes, trim

MB = 1_000_000
_STEP = 4 * MB
"""Measured budgets are whole multiples of this: memory differs a little from run to run, budgets then mostly do not."""
_LEAST = 8 * MB
"""A map's budget is never made smaller."""


@dataclass
class MemoryBudget:
    """What the map may take of a memory limit. What the program needs besides is measured while it works.

    Args:
        limit: of the resident memory, bytes; 0: none.
        given: bytes for the map, whatever is measured; 0: what is left of the limit.

    Raises:
        ConfigError: the program takes more than the limit before it has begun.
    """

    limit: int
    given: int = 0

    def __post_init__(self) -> None:
        self.map_bytes: int | None = self.given or None
        """None: not measured yet; everything may stay in memory."""
        if self.limit:
            release_early()
        self.program_bytes = resident_bytes()
        """The most that was found to be not map: what stays, and what passes within a step."""
        self._peak = 0
        self.notes: list[str] = []
        if self.limit and self.program_bytes + _LEAST > self.limit:
            raise ConfigError(
                f"memory_limit_mb={self.limit / MB:g}: the program itself takes {self.program_bytes / MB:.0f} MB "
                f"before the first frame; expected at least {(self.program_bytes + _LEAST) / MB:.0f}, and more for "
                "images and a map"
            )

    def measure(self, held: int) -> None:
        """After the first keyframes, when every part has run once.

        Args:
            held: bytes that map and images take now.
        """
        if self.map_bytes is not None or not self.limit:
            return
        self.program_bytes = 0
        self._measure_program(held)
        left = self.limit - self.program_bytes
        if left < _LEAST:
            self.notes.append(
                f"memory_limit_mb={self.limit / MB:g} cannot be kept: the program itself takes "
                f"{self.program_bytes / MB:.0f} MB with these images; the map gets {_LEAST / MB:.0f} MB"
            )
        self.map_bytes = max(_LEAST, left // _STEP * _STEP)

    def check(self, held: int) -> bool:
        """After each further keyframe: what the program took more since then is taken from the map; whether it is.

        Args:
            held: as in `measure`, and no less than at any moment since the last call.
        """
        if not self.limit or self.map_bytes is None:
            return False
        if resident_bytes() > self.limit - _STEP:
            trim()
        self._measure_program(held)
        if self.given or self.map_bytes <= _LEAST or self.program_bytes <= self.limit - self.map_bytes:
            return False
        left = max(_LEAST, (self.limit - self.program_bytes) // _STEP * _STEP)
        before, self.map_bytes = self.map_bytes, min(self.map_bytes, left)
        return self.map_bytes < before

    def _measure_program(self, held: int) -> None:
        """The largest resident memory so far counts where it is new: it passed since the last call."""
        peak = peak_memory_bytes()
        found = peak if peak > self._peak else resident_bytes()
        self._peak = max(self._peak, peak)
        self.program_bytes = max(self.program_bytes, found - held)
