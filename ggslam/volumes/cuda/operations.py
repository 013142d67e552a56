# SPDX-License-Identifier: Apache-2.0
"""Operations on a map that the host does not wait for: how they went comes back by itself, some later."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import torch

from ggslam.abi.cuda import FUSED_COUNTS, FusedCount

UNDER_WAY: Final = 4
"""Operations that may be under way at a time."""


class OperationRing:
    """Remembers the last operations, so that those can be started again which had no room.

    Args:
        counts: int32 [FUSED_COUNTS] of the map, on the device.
    """

    def __init__(self, counts: torch.Tensor) -> None:
        self._counts, self._device = counts, counts.device
        on_device = counts.device.type == "cuda"
        self._status = [torch.zeros(FUSED_COUNTS, dtype=torch.int32, pin_memory=on_device) for _ in range(UNDER_WAY)]
        self._events = [torch.cuda.Event() if on_device else None for _ in range(UNDER_WAY)]
        self._starts: list[Callable[[int], None] | None] = [None] * UNDER_WAY
        self._last = self._before = 0  # the map was emptied after operation number _before

    @property
    def next_place(self) -> int:
        """Where in the ring the next operation will be."""
        return (self._last + 1) % UNDER_WAY

    def oldest(self) -> np.ndarray | None:
        """How the operation went, int32 [FUSED_COUNTS], whose place the next one takes; None: there is none. The host
        waits for it, which the device has mostly done long ago."""
        place = self.next_place
        if self._starts[place] is None:
            return None
        self._wait(place)
        return self._status[place].numpy()

    def newest(self) -> np.ndarray:
        """How all went, int32 [FUSED_COUNTS]; the host waits for them."""
        if not self.has_begun:
            return np.zeros(FUSED_COUNTS, np.int32)
        place = self._last % UNDER_WAY
        self._wait(place)
        return self._status[place].numpy()

    def start(self, operation: Callable[[int], None]) -> None:
        """Starts an operation, which is given its number."""
        self._last += 1
        self._starts[self._last % UNDER_WAY] = operation
        self._run(self._last)

    def operation(self, number: int) -> Callable[[int], None] | None:
        """One of the last operations."""
        return self._starts[number % UNDER_WAY]

    @property
    def has_begun(self) -> bool:
        """Whether there were any since the map was emptied."""
        return self._last > self._before

    def start_again(self, stopped: np.ndarray) -> None:
        """Starts those again that did nothing for lack of room.

        Args:
            stopped: counts that say from which number on, int32 [FUSED_COUNTS].
        """
        first = int(stopped[FusedCount.STOPPED_AT])
        self._counts[FusedCount.STOPPED_AT : FusedCount.STOPPED_AT + 1].zero_()
        for number in range(first, self._last + 1):
            self._run(number)

    def forget(self) -> None:
        """The operations so far will not be started again: the map was emptied."""
        self._starts = [None] * UNDER_WAY
        self._before = self._last

    def _run(self, number: int) -> None:
        place = number % UNDER_WAY
        operation = self._starts[place]
        assert operation is not None
        operation(number)
        self._status[place].copy_(self._counts, non_blocking=True)
        event = self._events[place]
        if event is not None:
            event.record(torch.cuda.current_stream(self._device))

    def _wait(self, place: int) -> None:
        event = self._events[place]
        if event is not None and not event.query():
            event.synchronize()
