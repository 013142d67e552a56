# SPDX-License-Identifier: Apache-2.0
"""Copies from the device to memory that is page-locked once and used again and again."""

from __future__ import annotations

import torch

from ggslam.cuda.transfers import Marker


class Fetch:
    """A copy on its way to the host.

    Args:
        arriving: in page-locked memory.
        arrived: the end of the copy.
    """

    def __init__(self, arriving: torch.Tensor, arrived: Marker) -> None:
        self._arriving, self._arrived = arriving, arrived
        self.valid = True
        """False: another copy has taken the memory."""

    def mark(self) -> None:
        """The copy was started on the current stream."""
        self._arrived.set()

    def wait(self) -> torch.Tensor:
        """What was copied, once it is there. Others may take its memory later."""
        self._arrived.wait_if_ahead()
        return self._arriving


class FetchRing:
    """Page-locked memory for the latest copies.

    Args:
        device: where they come from.
        count: of copies that are kept.
    """

    def __init__(self, device: torch.device, count: int = 2) -> None:
        self._device = device
        self._memory = [torch.empty(0) for _ in range(count)]
        self._fetches: list[Fetch | None] = [None] * count
        self._next = 0

    def start(self, source: torch.Tensor) -> Fetch:
        """Starts to copy float32 [n] on the current stream; the oldest copy goes."""
        slot, self._next = self._next, (self._next + 1) % len(self._memory)
        before = self._fetches[slot]
        if before is not None:
            before.valid = False
        if len(self._memory[slot]) < len(source):
            pinned = self._device.type == "cuda"
            self._memory[slot] = torch.empty(len(source) + len(source) // 4, pin_memory=pinned)
        arriving = self._memory[slot][: len(source)]
        arriving.copy_(source, non_blocking=True)
        fetch = Fetch(arriving, Marker(self._device))
        fetch.mark()
        self._fetches[slot] = fetch
        return fetch
