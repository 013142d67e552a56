# SPDX-License-Identifier: Apache-2.0
"""Device memory for the kernels. All of it is torch's own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import torch

from ggslam.system.tuning import Tuning


_Made = TypeVar("_Made")


class SizeTuning(Tuning):
    """Memory that is kept for images of several sizes."""

    kept = 4
    """Sizes: steps on pictures of other sizes than the recording's take turns with those of its own."""


class SlotTuning(Tuning):
    """Memory that is handed out in pieces."""

    at_once = 16
    """Slots allocated at a time."""


class GrowingMemory:
    """Bytes on a device that are kept from one rendering to the next and grow by a quarter more than is asked for.

    Args:
        device: where.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._blocks: dict[str, torch.Tensor] = {}
        self.allocations = 0
        """Increases when a block moves, so that addresses can be seen to be stale."""

    def block(self, name: str, size: int) -> torch.Tensor:
        """uint8 [at least `size`] of that name; its content is undefined."""
        block = self._blocks.get(name)
        if block is None or block.numel() < size:
            self.allocations += 1
            self._blocks.pop(name, None)  # free before asking for more
            block = self._blocks[name] = torch.empty(size + size // 4, dtype=torch.uint8, device=self._device)
        return block


class BySize(Generic[_Made]):
    """What is made once for images of a size, kept for the sizes that were asked for last.

    Args:
        make: makes it for height and width.
    """

    def __init__(self, make: Callable[[int, int], _Made]) -> None:
        self._make = make
        self._made: dict[tuple[int, int], _Made] = {}

    def of(self, height: int, width: int) -> _Made:
        """That of a size."""
        size = height, width
        made = self._made.pop(size, None)
        self._made[size] = self._make(height, width) if made is None else made  # the one used last stands last
        if len(self._made) > SizeTuning.kept:
            del self._made[next(iter(self._made))]
        return self._made[size]


class Slots:
    """Tensors of one shape, allocated many at a time, that are used again.

    Args:
        shape: of each.
        dtype: of each.
        device: where.
    """

    def __init__(self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> None:
        self._shape, self._dtype, self._device = shape, dtype, device
        self._spare: list[torch.Tensor] = []

    def make_room(self) -> None:
        """Makes some if there is none: to be called while nobody minds an allocation."""
        if not self._spare:
            many = torch.empty((SlotTuning.at_once, *self._shape), dtype=self._dtype, device=self._device)
            self._spare = list(many.unbind())

    def take(self) -> torch.Tensor:
        """One of them; its content is undefined."""
        self.make_room()
        return self._spare.pop()

    def give_back(self, slot: torch.Tensor) -> None:
        """One that is used no more by what is started from now on."""
        self._spare.append(slot)
