# SPDX-License-Identifier: Apache-2.0
"""Memory of a map on a device, and its growth."""

from __future__ import annotations

import ctypes
from ctypes import sizeof

import torch

from ggslam.abi.cuda import FUSED_COUNTS, FusedBlock, FusedMap, FusedMoveJob, FusedPoints, FusedVoxels
from ggslam.cuda.library import CudaLibrary
from ggslam.volumes.cuda.room import Room
from ggslam.volumes.settings import TsdfSettings


class MapMemory:
    """The arrays of a `FusedMap`.

    Args:
        library: the kernels.
        device: where.
        settings: of the fusion.
        points: whether measured points are counted.
        room: at first.

    Attributes:
        counts: int32 [FUSED_COUNTS] on the device, see `FusedCount`.
        room: that there is now.
    """

    def __init__(
        self, library: CudaLibrary, device: torch.device, settings: TsdfSettings, points: bool, room: Room
    ) -> None:  # fmt: skip
        self._library, self._device, self._settings, self.points = library, device, settings, points
        self.counts = torch.zeros(FUSED_COUNTS, dtype=torch.int32, device=device)
        self.room = room
        self._arrays = self._allocate(room, {})
        self.clear()

    def structure(self) -> FusedMap:
        """For the kernels; valid until the map grows."""
        return self._structure(self._arrays, self.room)

    def read(self, name: str, count: int) -> torch.Tensor:
        """The first `count` of "blocks", "voxels" or "points", uint8 [count, bytes] on the device."""
        kind = {"blocks": FusedBlock, "voxels": FusedVoxels, "points": FusedPoints}[name]
        return self._arrays[name][: count * sizeof(kind)].view(count, sizeof(kind))

    @property
    def bytes(self) -> int:
        """Bytes of all arrays."""
        return sum(array.numel() * array.element_size() for array in self._arrays.values())

    def clear(self) -> None:
        """Empties the map."""
        self._call("fused_clear", FusedMap(), self.structure())

    def grow(self, room: Room) -> None:
        """Moves the map to larger memory; what was started before still reads the old one."""
        same = ("voxels", "points") if room.slots == self.room.slots else ()
        kept = {name: self._arrays[name] for name in same if name in self._arrays}
        before, now = self.structure(), self._allocate(room, kept)
        self._call("fused_move", before, self._structure(now, room))
        self._arrays, self.room = now, room

    def _call(self, name: str, before: FusedMap, after: FusedMap) -> None:
        job = FusedMoveJob(before, after, self._library.stream(self._device), self._device.index or 0)
        self._library.call(name, ctypes.byref(job))

    def _allocate(self, room: Room, kept: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        sizes = {
            "keys": 8 * room.places, "rows": 4 * room.places, "blocks": sizeof(FusedBlock) * room.rows,
            "voxels": sizeof(FusedVoxels) * room.slots, "free_slots": 4 * room.slots,
        }  # fmt: skip
        if self.points:
            sizes["points"] = sizeof(FusedPoints) * room.slots
        fresh = {n: s for n, s in sizes.items() if n not in kept}
        return {**kept, **{n: torch.empty(s, dtype=torch.uint8, device=self._device) for n, s in fresh.items()}}

    def _structure(self, arrays: dict[str, torch.Tensor], room: Room) -> FusedMap:
        s = self._settings
        return FusedMap(
            **{name: array.data_ptr() for name, array in arrays.items()}, counts=self.counts.data_ptr(),
            place_mask=room.places - 1, row_room=room.rows, slot_room=room.slots, voxel=s.voxel,
            truncation=s.truncation, max_weight=s.max_weight,
        )  # fmt: skip
