# SPDX-License-Identifier: Apache-2.0
"""Device memory for the kernels. All of it is torch's own."""

from __future__ import annotations

import torch


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

    def kept_block(self, name: str, size: int) -> torch.Tensor:
        """As `block`, but its content stays: where it has to grow, it doubles and is copied."""
        block = self._blocks.get(name)
        if block is None or block.numel() < size:
            self.allocations += 1
            held = 0 if block is None else block.numel()
            larger = torch.empty(max(size, 2 * held), dtype=torch.uint8, device=self._device)
            if block is not None:
                larger[:held].copy_(block)
            block = self._blocks[name] = larger
        return block
