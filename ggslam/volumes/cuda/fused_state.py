# SPDX-License-Identifier: Apache-2.0
"""A map on a device with what is under way on it: room is made before it is needed, and where it was not enough,
operations are started again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from ggslam.abi.cuda import FUSED_COUNTS, FusedCount
from ggslam.cuda.library import CudaLibrary
from ggslam.volumes.cuda.fusion_jobs import FusionMemory
from ggslam.volumes.cuda.map_memory import MapMemory
from ggslam.volumes.cuda.operations import UNDER_WAY, OperationRing
from ggslam.volumes.cuda.room import Room, RoomTuning
from ggslam.volumes.cuda.view_inputs import ViewImages
from ggslam.volumes.settings import TsdfSettings


class FusedState:
    """See above.

    Args:
        library: the kernels.
        device: where.
        settings: of the fusion.
        points: whether measured points are counted.
        room: at first.

    Attributes:
        memory: of the map.
        fusion: what fusing works in.
        ring: operations under way.
        images: of views, by their place in the ring.
        grown: called with the new room after the map grew.
        cleared: called after the map was emptied.
        recent_blocks: blocks of the map some operations ago.
    """

    def __init__(
        self, library: CudaLibrary, device: torch.device, settings: TsdfSettings, points: bool, room: Room
    ) -> None:  # fmt: skip
        self.settings = settings
        self.memory = MapMemory(library, device, settings, points, room)
        self.fusion = FusionMemory(library, device, settings, points)
        self.ring = OperationRing(self.memory.counts)
        self.images = [ViewImages(device) for _ in range(UNDER_WAY)]
        self.grown: list[Callable[[Room], None]] = []
        self.cleared: list[Callable[[], None]] = []
        self.recent_blocks = 0
        self._begun = np.zeros(FUSED_COUNTS, np.int32)

    def begin_with(self, counts: np.ndarray) -> None:
        """The map is not empty: its counts, int32 [FUSED_COUNTS]."""
        self._begun = counts

    def make_room(self) -> None:
        """To be called before an operation: what went before it fits for certain, and there is room for more."""
        counts = self.ring.oldest()
        if counts is None:
            return
        if counts[FusedCount.STOPPED_AT]:
            counts = self.settle()
        room, self.recent_blocks = self.memory.room, int(counts[FusedCount.PRESENT_BLOCKS])
        used = {
            "rows": counts[FusedCount.ROWS_USED], "updates": counts[FusedCount.UPDATE_COUNT],
            "slots": counts[FusedCount.SLOTS_USED], "sites": counts[FusedCount.SITE_SLOTS_USED],
            "listed": max(counts[FusedCount.CANDIDATE_COUNT], *counts[FusedCount.LEVEL_COUNTS :]),
        }  # fmt: skip
        full = {n: getattr(room, n) + 1 for n, c in used.items() if c > RoomTuning.nearly_full * getattr(room, n)}
        if full:
            self._grow(room.with_room_for(**full))

    def settle(self) -> np.ndarray:
        """Counts int32 [FUSED_COUNTS] when all that was started is done, for which the host waits.

        Raises:
            VoxelError: a view shows too many blocks for voxels of this size; the others are fused.
        """
        counts, refused = self.ring.newest(), []
        while counts[FusedCount.STOPPED_AT]:
            operation: Any = self.ring.operation(int(counts[FusedCount.STOPPED_AT]))
            if hasattr(operation, "is_too_large") and operation.is_too_large(counts):
                refused.append(operation)
            else:
                self._grow(self.memory.room.with_room_for(**_room_for_all(counts)))
            self.ring.start_again(counts.copy())
            counts = self.ring.newest()
        for operation in refused:
            operation.check()
        return counts if self.ring.has_begun else self._begun

    def clear(self) -> None:
        """Empties the map."""
        self.memory.clear()
        self.ring.forget()
        self._begun, self.recent_blocks = np.zeros(FUSED_COUNTS, np.int32), 0
        for call in self.cleared:
            call()

    def _grow(self, room: Room) -> None:
        if room != self.memory.room:
            self.memory.grow(room)
            for call in self.grown:
                call(room)


def _room_for_all(counts: np.ndarray) -> dict[str, int]:
    names = {
        "rows": FusedCount.ROWS_NEEDED, "slots": FusedCount.SLOTS_NEEDED, "listed": FusedCount.LIST_NEEDED,
        "updates": FusedCount.UPDATES_NEEDED, "sites": FusedCount.SITE_SLOTS_NEEDED,
    }  # fmt: skip
    return {name: int(counts[count]) for name, count in names.items()}
