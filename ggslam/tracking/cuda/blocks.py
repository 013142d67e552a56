# SPDX-License-Identifier: Apache-2.0
"""Memory of the device that is used again as soon as nobody needs what is in it."""

from __future__ import annotations

import torch

_Piece = tuple[torch.Tensor, int, int]
"""Memory, how many numbers it has room for, and its address."""


class Block:
    """A piece of a `BlockPool`, to which it goes back when this object does.

    Attributes:
        memory: float32 [n] on the device, its content undefined.
        address: of its first number.
    """

    def __init__(self, memory: torch.Tensor, count: int, address: int, free: list[_Piece]) -> None:
        self.memory, self.address = memory, address
        self._count = count
        self._free = free

    def __del__(self) -> None:
        self._free.append((self.memory, self._count, self.address))


class BlockPool:
    """Pieces of device memory of much the same size. Who reads one beside the stream that writes it waits until that is
    done before he lets go of it.

    Args:
        device: where.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._free: list[_Piece] = []

    def take(self, count: int) -> Block:
        """A piece with room for so many float32, in one that is free or a new one."""
        while self._free:
            memory, room, address = self._free.pop()
            if room >= count:
                return Block(memory, room, address, self._free)
        room = count + count // 4
        memory = torch.empty(room, dtype=torch.float32, device=self._device)
        return Block(memory, room, memory.data_ptr(), self._free)
