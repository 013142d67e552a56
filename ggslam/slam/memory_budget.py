# SPDX-License-Identifier: Apache-2.0
"""Computes the bytes that a map may take from a limit on resident memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from ggslam.errors import ConfigError
from ggslam.system.process_memory import peak_memory_bytes, release_early, resident_bytes, trim
from ggslam.system.tuning import Tuning

MB: Final = 1_000_000
"""Bytes of a megabyte (SI)."""


class BudgetTuning(Tuning):
    """How the memory of the map is budgeted."""

    step_bytes = 4 * MB
    """Budgets are multiples of this many bytes, so that they mostly repeat from run to run."""
    min_bytes = 8 * MB
    """Smallest budget of a map, in bytes."""


@dataclass
class MemoryBudget:
    """The share of a memory limit that the map may take. The memory of the rest of the program is measured.

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
        if self.limit and self.program_bytes + BudgetTuning.min_bytes > self.limit:
            raise ConfigError(
                f"memory_limit_mb={self.limit / MB:g}: the program itself takes {self.program_bytes / MB:.0f} MB "
                f"before the first frame; expected at least "
                f"{(self.program_bytes + BudgetTuning.min_bytes) / MB:.0f}, and more for images and a map"
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
        if left < BudgetTuning.min_bytes:
            self.notes.append(
                f"memory_limit_mb={self.limit / MB:g} cannot be kept: the program itself takes "
                f"{self.program_bytes / MB:.0f} MB with these images; the map gets {BudgetTuning.min_bytes / MB:.0f} MB"
            )
        self.map_bytes = max(BudgetTuning.min_bytes, left // BudgetTuning.step_bytes * BudgetTuning.step_bytes)

    def check(self, held: int) -> bool:
        """After each further keyframe: what the program took more since then is taken from the map; whether it is.

        Args:
            held: as in `measure`, and no less than at any moment since the last call.
        """
        if not self.limit or self.map_bytes is None:
            return False
        if resident_bytes() > self.limit - BudgetTuning.step_bytes:
            trim()
        self._measure_program(held)
        if self.given or self.map_bytes <= BudgetTuning.min_bytes or self.program_bytes <= self.limit - self.map_bytes:
            return False
        left = max(
            BudgetTuning.min_bytes,
            (self.limit - self.program_bytes) // BudgetTuning.step_bytes * BudgetTuning.step_bytes,
        )
        before, self.map_bytes = self.map_bytes, min(self.map_bytes, left)
        return self.map_bytes < before

    def _measure_program(self, held: int) -> None:
        """The largest resident memory so far counts where it is new: it passed since the last call."""
        peak = peak_memory_bytes()
        found = peak if peak > self._peak else resident_bytes()
        self._peak = max(self._peak, peak)
        self.program_bytes = max(self.program_bytes, found - held)
