# SPDX-License-Identifier: Apache-2.0
"""Memory of a distance field on a device; it grows with its map."""

from __future__ import annotations

from ctypes import sizeof

import torch

from ggslam.abi.cuda import FieldArrays, FieldDistances, FieldNode, FieldRow, FieldSites
from ggslam.volumes.cuda.room import Room

_NODES = 1 + 8
"""Nodes of a block's sites: of all, and of its parts."""
_BY_ROW = {"rows": sizeof(FieldRow), "distances": sizeof(FieldDistances), "listed": 4}
_BY_SITES = {"sites": sizeof(FieldSites), "arrived": 4}
_NODE_ARRAYS = ("nodes", "arrivals")


class FieldMemory:
    """The arrays of a `FieldArrays`, uint8.

    Args:
        device: where.
        room: of the map at first.
    """

    def __init__(self, device: torch.device, room: Room) -> None:
        self._device, self._room = device, room
        self._arrays = self._allocate(room)

    def structure(self) -> FieldArrays:
        """For the kernels; valid until the field grows."""
        return FieldArrays(**{n: a.data_ptr() for n, a in self._arrays.items()}, site_room=self._room.sites)

    @property
    def bytes(self) -> int:
        """Bytes of all arrays."""
        return sum(array.numel() for array in self._arrays.values())

    def read(self, name: str, count: int) -> torch.Tensor:
        """The first `count` of "rows", "distances" or "sites", uint8 [count, bytes] on the device."""
        return self._arrays[name][:count]

    def clear(self) -> None:
        """Forgets all distances and sites."""
        self._arrays["rows"].zero_()

    def grow(self, room: Room) -> None:
        """Moves to larger memory."""
        before, now = self._arrays, self._allocate(room)
        for name, array in before.items():
            if name in _NODE_ARRAYS:
                now[name][:, : array.shape[1]].copy_(array)
            else:
                now[name][: len(array)].copy_(array)
        self._arrays, self._room = now, room

    def _allocate(self, room: Room) -> dict[str, torch.Tensor]:
        shapes: dict[str, tuple[int, ...]] = {name: (room.rows, size) for name, size in _BY_ROW.items()}
        shapes |= {name: (room.sites, size) for name, size in _BY_SITES.items()}
        shapes |= {name: (_NODES, room.sites, sizeof(FieldNode)) for name in _NODE_ARRAYS}
        arrays = {
            name: torch.empty(shape, dtype=torch.uint8, device=self._device)
            for name, shape in shapes.items() if name != "rows"
        }  # fmt: skip
        return arrays | {"rows": torch.zeros(shapes["rows"], dtype=torch.uint8, device=self._device)}
