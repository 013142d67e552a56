# SPDX-License-Identifier: Apache-2.0
"""Records of a cell in the index of a grid store, and requests to write one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ggslam.submaps.cell_keys import CellKey


@dataclass(frozen=True)
class PartRecord:
    """One named part of a cell: the version it was written with, things in it, size in bytes, CRC-32 of the bytes."""

    version: int
    count: int
    bytes: int
    crc: int


@dataclass(frozen=True)
class CellRecord:
    """A cell as it lies on the disk.

    Attributes:
        key: its whole coordinates.
        recorded_at: time of its recording in seconds, on the clock of the recordings; None: never recorded.
        visit: the visit that wrote it last, or None.
        version: number of the last write to it; no two writes to a store have the same.
        parts: by name.
    """

    key: CellKey
    recorded_at: float | None
    visit: str | None
    version: int
    parts: Mapping[str, PartRecord]

    @property
    def bytes(self) -> int:
        """Size of all parts together."""
        return sum(part.bytes for part in self.parts.values())


@dataclass(frozen=True)
class CellWrite:
    """A cell to write.

    Attributes:
        key: its whole coordinates.
        parts: content by file name ("points.pcd", "gaussians.npz", ...). Parts of the cell not named here stay.
        recorded_at: time of the recording in seconds, on one clock for all visits; None: this is no recording, the
            time there is stays (Gaussians that are paged out).
        counts: number of things (points, Gaussians, ...) in each part; 0 for parts not named.
        changed: share, 0 to 1, of the cell's content that changed (see `changed_share`); None: not compared.
    """

    key: CellKey
    parts: Mapping[str, bytes]
    recorded_at: float | None = None
    counts: Mapping[str, int] = field(default_factory=dict)
    changed: float | None = None


@dataclass(frozen=True)
class CellChange:
    """What visits did to a cell: whether they added it, and the share of its content that changed (None: unknown)."""

    key: CellKey
    added: bool
    changed: float | None
