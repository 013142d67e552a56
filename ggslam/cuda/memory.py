# SPDX-License-Identifier: Apache-2.0
"""Device memory for the kernels. All of it is torch's own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import torch

from ggslam.system.tuning import Tuning

_Kind = TypeVar("_Kind")
_Made = TypeVar("_Made")


class KindTuning(Tuning):
    """Memory that is kept for work of several kinds."""

    kept = 4
    """Kinds: steps on pictures of other sizes than the recording's take turns with those of its own."""


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


class ByKind(Generic[_Kind, _Made]):
    """What is made once for images of a size, or for another kind of work, kept for the kinds that were asked for last.

    Args:
        make: makes it.
    """

    def __init__(self, make: Callable[[_Kind], _Made]) -> None:
        self._make = make
        self._made: dict[_Kind, _Made] = {}

    def of(self, kind: _Kind) -> _Made:
        """That of a kind."""
        made = self._made.pop(kind, None)
        if made is None:
            made = self._make(kind)
        self._made[kind] = made  # the one used last stands last
        if len(self._made) > KindTuning.kept:
            del self._made[next(iter(self._made))]
        return made


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
        if not self._spare:
            self.make_room()
        return self._spare.pop()

    def give_back(self, slot: torch.Tensor) -> None:
        """One that is used no more by what is started from now on."""
        self._spare.append(slot)
