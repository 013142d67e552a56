# SPDX-License-Identifier: Apache-2.0
"""How much a map on a device has room for."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ggslam.system.tuning import Tuning


class RoomTuning(Tuning):
    """Memory of a map on a device."""

    rows = 1 << 15
    """Blocks that there is room for at first, those that are free throughout counted."""
    slots = 1 << 13
    """Blocks with voxels that there is room for at first, 6 kB each."""
    listed = 1 << 16
    """Blocks that a view may tell about at first."""
    updates = 1 << 13
    """Blocks whose voxels a view may change at first."""
    sites = 1 << 12
    """Blocks with surface that a distance field has room for at first, 16 kB each."""
    nearly_full = 0.7
    """Share of the room from which on it grows, before a view does not fit."""
    growth = 2.0
    """Factor by which it grows at least."""


@dataclass(frozen=True)
class Room:
    """Rows, slots with voxels, blocks listed by a view, blocks changed by a view, blocks with surface of a field."""

    rows: int = RoomTuning.rows
    slots: int = RoomTuning.slots
    listed: int = RoomTuning.listed
    updates: int = RoomTuning.updates
    sites: int = RoomTuning.sites

    def with_room_for(self, **needed: int) -> Room:
        """With at least so much, and a factor more than now where that is more than now."""
        more = {
            name: max(count, int(RoomTuning.growth * getattr(self, name)))
            for name, count in needed.items() if count > getattr(self, name)
        }  # fmt: skip
        return replace(self, **more)

    @property
    def places(self) -> int:
        """Places of the hash table: at most half of them are taken."""
        return 1 << max(6, (2 * self.rows - 1).bit_length())
