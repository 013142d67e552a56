# SPDX-License-Identifier: Apache-2.0
"""Memory of the device that is used again as soon as nobody needs what is in it."""

from __future__ import annotations

import torch


class Block:
    """A piece of a `BlockPool`, to which it goes back when this object does.

    Attributes:
        memory: float32 [n] on the device, its content undefined.
        address: of its first number.
    """

    def __init__(self, memory: torch.Tensor, address: int, free: list[tuple[torch.Tensor, int]]) -> None:
        self.memory, self.address = memory, address
        self._free = free

    def __del__(self) -> None:
        self._free.append((self.memory, self.address))


class BlockPool:
    """Pieces of device memory of much the same size. Who reads one beside the stream that writes it waits until that is
    done before he lets go of it.

    Args:
        device: where.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._free: list[tuple[torch.Tensor, int]] = []

    def take(self, count: int) -> Block:
        """A piece with room for so many float32, in one that is free or a new one."""
        while self._free:
            memory, address = self._free.pop()
            if len(memory) >= count:
                return Block(memory, address, self._free)
        memory = torch.empty(count + count // 4, dtype=torch.float32, device=self._device)
        return Block(memory, memory.data_ptr(), self._free)
