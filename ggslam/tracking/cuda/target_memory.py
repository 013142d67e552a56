# SPDX-License-Identifier: Apache-2.0
"""Device memory of a target: one block with room for what further keyframes bring."""

from __future__ import annotations

from ctypes import sizeof

import torch

from ggslam.abi.core import TargetChanges, Voxel, VoxelMoments
from ggslam.abi.cuda import VoxelLevelJob, VoxelSlot
from ggslam.system.tuning import Tuning


class TargetMemoryTuning(Tuning):
    """Memory of targets on the device."""

    min_slots_per_block = 4
    """Fewest slots of the hash table per block, so that most look-ups end at the first slot."""
    ahead = 1.5
    """Where memory does not suffice, there will be so much of what is needed."""
    alignment = 256
    """Parts begin at multiples of so many bytes."""


_SENT, _TABLES, _VOXELS, _MOMENTS = 0, 1, 3, 5  # parts: what is sent, then by level
_PARTS = 7


class _Block:
    """Parts one behind the other, of some sizes in bytes."""

    def __init__(self, sizes: list[int], device: torch.device) -> None:
        self.sizes = sizes
        aligned = [-size % TargetMemoryTuning.alignment + size for size in sizes]
        self.begins = [sum(aligned[:k]) for k in range(len(sizes))]
        self.memory = torch.empty(sum(aligned), dtype=torch.uint8, device=device)
        self.address = self.memory.data_ptr()
        self.at = [self.address + begin if size else None for begin, size in zip(self.begins, sizes, strict=True)]
        """Addresses of the parts; None: there is none."""
        self.slots = [self.sizes[_TABLES + level] // sizeof(VoxelSlot) for level in (0, 1)]
        """Of the tables."""

    def pieces(self, sizes: list[int]) -> list[torch.Tensor]:
        """The beginnings of the parts, uint8 [size]."""
        cuts: list[int] = []
        ends = [*self.begins[1:], self.memory.numel()]
        for begin, end, size in zip(self.begins, ends, sizes, strict=True):
            cuts += [size, end - begin - size]
        return list(self.memory.split_with_sizes(cuts))[::2]


class TargetMemory:
    """Where a target is on the device. A larger block is allocated by `reserve`, which may be called long before the
    memory is used, in any thread, one at a time; `use` goes over to it.

    Args:
        device: where.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        # Memory that a stream's work may still be using must not come to another stream.
        self._stream = torch.cuda.current_stream(device) if device.type == "cuda" else None
        self._block = self._reserved = _Block([0] * _PARTS, device)
        self._before: tuple[_Block, VoxelLevelJob, VoxelLevelJob] | None = None  # which they may be reading
        self._values: tuple[list[torch.Tensor], list[torch.Tensor]] = [], []  # in use, and where they go as this grows

    @property
    def address(self) -> int:
        """Of what is in use; what is sent goes there."""
        return self._block.address

    def reserve(self, changes: TargetChanges, size: int, has_moments: bool) -> torch.Tensor:
        """Makes sure that there is memory for a target; returns where to send what the device lacks, uint8 [size].

        Args:
            changes: what the device lacks of it.
            size: bytes of that.
            has_moments: whether its voxels get their shapes on the device.
        """
        levels = changes.fine, changes.coarse
        values = [sizeof(Voxel), sizeof(VoxelMoments) if has_moments else 0]
        needed = [size, *(_table_bytes(level.all_blocks) for level in levels)]
        needed += [each * max(1, level.places) for each in values for level in levels]
        held = self._reserved.sizes
        if all(want <= have for want, have in zip(needed, held, strict=True)):
            return self._reserved.memory[:size]
        ahead = TargetMemoryTuning.ahead
        wanted = [int(ahead * size), *(_table_bytes(int(ahead * level.all_blocks)) for level in levels)]
        wanted += [int(ahead * bytes_) for bytes_ in needed[_VOXELS:]]
        with torch.cuda.stream(self._stream):
            self._reserved = _Block([max(*pair) for pair in zip(wanted, held, strict=True)], self._device)
        kept = [0] * _VOXELS + self._block.sizes[_VOXELS:]
        self._values = self._block.pieces(kept)[_VOXELS:], self._reserved.pieces(kept)[_VOXELS:]
        return self._reserved.memory[:size]

    def use(self, keep: bool, fine: VoxelLevelJob, coarse: VoxelLevelJob) -> None:
        """Has the jobs use what is reserved. Where that is another block than before, it takes over what is in it if
        that is to be kept: the jobs move the tables."""
        before, block = self._block, self._reserved
        moves = keep and before is not block
        for level, job in enumerate((fine, coarse)):
            if moves:
                job.old_slots, job.old_mask = before.at[_TABLES + level], before.slots[level] - 1
            else:
                job.old_slots = None
            job.level.slots, job.level.slot_mask = block.at[_TABLES + level], block.slots[level] - 1
            job.voxels, job.moments = block.at[_VOXELS + level], block.at[_MOMENTS + level]
        if moves:
            old, new = self._values
            torch._foreach_copy_(new, old)
        if before is not block:
            self._block, self._before, self._values = block, (before, fine, coarse), ([], [])

    def note_used(self) -> None:
        """The host has waited for the work that `use` was called for: what was there before is given back."""
        if self._before is not None:
            _, *jobs = self._before
            for job in jobs:
                job.old_slots = None
            self._before = None


def _table_bytes(blocks: int) -> int:
    """Of a hash table with a power of two of slots."""
    least = max(64, TargetMemoryTuning.min_slots_per_block * blocks)
    return sizeof(VoxelSlot) << (least - 1).bit_length()
