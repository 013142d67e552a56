# SPDX-License-Identifier: Apache-2.0
"""Keeps what is far away of a TSDF on disk, in cells, and brings it back, bit for bit, before a view is fused that may
tell of it.

What is fused is the same as without a pager. The distance field follows the TSDF: what leaves it has no distances, so
cells around those in view stay as far as distances reach. Distances farther away are those of what is in memory, see
`volumes.held_distances`.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from ggslam.scene.arrays import arrays_to_bytes, read_all_arrays, read_arrays
from ggslam.system.atomic import write_bytes
from ggslam.system.tuning import Tuning
from ggslam.volumes.block_arrays import decay_blocks, put_blocks, take_blocks
from ggslam.volumes.cell_rebuild import CellRebuild, StoredView
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.held_distances import HeldDistanceTuning, distance_to_cells
from ggslam.volumes.posed_view import PosedView
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.volume_cells import CellKey, VolumeCells, as_keys, with_neighbours

_CONTENT = "cell of a TSDF"


class CellPagerTuning(Tuning):
    """What is kept in memory."""

    slack = 0.15
    """Share of the memory that is freed beyond need, so that not every view has to free some."""
    block_bytes = 64
    """Taken by a block besides its voxels."""
    voxel_bytes = 5120
    """Taken by the voxels of a block."""
    point_bytes = 1024
    """Taken by the measured points of a block, where they are counted."""


class CellPager:
    """A TSDF whose cells are partly on disk.

    Args:
        tsdf: all of it is in memory.
        folder: for the cells; made when the first one goes, gone when the pager is closed.
        allowed: bytes that TSDF and distance field may take, of those that they take now; None: any.
        distances: metres around what is in view that stay in memory, too.

    Attributes:
        tsdf, cells: the TSDF and its grid.
        folder: where cells are.
        written, read: cells that went to disk, and that came back because views needed them.
        most_bytes: the most that TSDF and distance field took when an instant was done.
        exceeded: whether that was more than allowed: what one instant's views need has to be in memory.
    """

    def __init__(
        self, tsdf: TsdfMap, folder: Path, allowed: Callable[[int], int | None], distances: float = 0.0
    ) -> None:
        self.cells = VolumeCells.of(tsdf.settings)
        self.written = self.read = self.most_bytes = 0
        self.exceeded = False
        self.tsdf, self.folder, self._allowed = tsdf, folder, allowed
        beside = HeldDistanceTuning.margin_voxels * tsdf.settings.voxel
        self._around = math.ceil((distances + beside) / self.cells.edge) if distances else 0
        self._away: dict[CellKey, int] = {}
        """Cells on disk, and how often weights had decayed when they went."""
        self._wanted: set[CellKey] = set()
        """Of the instant that is going on."""
        self._last_seen: dict[CellKey, int] = {}
        self._instant = self._decays = 0
        self._stale: CellRebuild | None = None

    def __len__(self) -> int:
        """Cells on disk."""
        return len(self._away)

    # --- coming back -------------------------------------------------------------------------------------------------

    def bring(self, images: Iterable[PosedView]) -> None:
        """Brings what views may tell of, before they are fused."""
        if not len(self.tsdf) and not self._away and self._stale is None:
            return  # the first view decides where the origin is
        seen: set[CellKey] = set()
        for image in images:
            seen |= as_keys(self.cells.in_view(image, self.tsdf.origin))
        self._wanted |= with_neighbours(seen, self._around)
        if self._stale is not None:
            self._stale.build(self._wanted, self.tsdf, self._decays)
        coming = self._wanted & self._away.keys()
        self.read += len(coming)
        self._load(coming)

    def write_all(self) -> None:
        """Has all cells on disk, and none in memory, if some are there or are to be fused again; else none is."""
        if self._stale is not None:
            self._stale.build_all(self.tsdf, self._decays, lambda: self.finish_instant(None))
            self._stale = None
        if self._away:
            self._instant += 1
            self._free(self.held_bytes(None) + 1, None)
        for key in [key for key, decays in self._away.items() if decays != self._decays]:
            self._write(key, self.arrays(key))  # once, for all that reads them now

    def relabel(self, table: np.ndarray) -> None:
        """Gives objects on disk their new ids, uint16 [65536] by old one; all cells have been fused."""
        for key in sorted(self._away):
            arrays = self.arrays(key)
            self._write(key, {**arrays, "label": table[arrays["label"]]})

    def counts(self) -> tuple[int, int]:
        """Blocks on disk, and those of them with voxels."""
        sizes = [[len(self.arrays(key)[name]) for name in ("dense", "free")] for key in self._away]
        dense, free = np.sum(sizes, axis=0).tolist() if sizes else (0, 0)
        return dense + free, dense

    def coordinates(self) -> np.ndarray:
        """Of all blocks on disk, as they were written, int32 [B, 3]."""
        parts = [read_arrays(self._path(key), _CONTENT, "dense", "free") for key in sorted(self._away)]
        return np.concatenate([np.zeros((0, 3), np.int32), *(blocks for part in parts for blocks in part)])

    def keys(self) -> set[CellKey]:
        """Cells on disk."""
        return set(self._away)

    def rebuild(self, views: Sequence[StoredView]) -> None:
        """Begins anew from views, after a loop was closed: each cell is fused again when it is needed next."""
        self.tsdf.clear()
        self.clear()
        self._stale = CellRebuild(views, self.cells, self.tsdf.origin)

    def border(self, points: np.ndarray, most: float) -> np.ndarray:
        """Metres [N] from points [N, 3] in the world to the nearest cell that is on disk or to be fused again; infinite
        where that is farther than `most`."""
        return distance_to_cells(points - self.tsdf.origin, self.cells, most, self._not_held)

    def _not_held(self, keys: set[CellKey]) -> set[CellKey]:
        away = keys & self._away.keys()
        return away if self._stale is None else away | self._stale.still_to_fuse(keys)

    def _load(self, keys: set[CellKey]) -> None:
        for key in sorted(keys):
            put_blocks(self.tsdf, self.arrays(key))
            self._path(key).unlink()
            del self._away[key]

    def arrays(self, key: CellKey) -> dict[str, np.ndarray]:
        """What a cell on disk holds, see `take_blocks`, with the weights of now."""
        return decay_blocks(read_all_arrays(self._path(key), _CONTENT), self.tsdf, self._decays - self._away[key])

    # --- going -------------------------------------------------------------------------------------------------------

    def decay(self) -> None:
        """Notes that the weights of what is in memory decayed; those on disk will when they come back."""
        self._decays += 1

    def finish_instant(self, field: DistanceField | None) -> None:
        """Writes what was not seen for the longest time to disk, if TSDF and distance field take too much memory."""
        self._instant += 1
        self._last_seen.update(dict.fromkeys(self._wanted, self._instant))
        held = self.held_bytes(field)
        allowed = self._allowed(held)
        if allowed is not None and held > allowed:
            held -= self._free(held - round((1 - CellPagerTuning.slack) * allowed), field)
            self.exceeded |= held > allowed
        self.most_bytes = max(self.most_bytes, held)
        self._wanted = set()

    def held_bytes(self, field: DistanceField | None) -> int:
        """Bytes of the TSDF's blocks, and of the field's."""
        return self._bytes_of(self.tsdf.dense_blocks, len(self.tsdf), self._field_bytes(field))

    def _bytes_of(self, dense: int, blocks: int, field_bytes: float) -> int:
        t = CellPagerTuning
        each = t.voxel_bytes + (t.point_bytes if self.tsdf.points else 0)
        return round(dense * each + blocks * (t.block_bytes + field_bytes))

    @staticmethod
    def _field_bytes(field: DistanceField | None) -> float:
        """Of each block."""
        return field.memory_bytes / len(field) if field is not None and len(field) else 0.0

    def _free(self, bytes_: int, field: DistanceField | None) -> int:
        """Writes cells to disk until so many bytes are free; returns how many are."""
        blocks, each = self.tsdf.blocks(), self._field_bytes(field)
        keys, cell_of = np.unique(self.cells.keys_of(blocks.coordinates), axis=0, return_inverse=True)
        order = sorted(range(len(keys)), key=lambda k: self._last_seen.get(_key(keys[k]), 0))
        by_cell, freed = np.argsort(cell_of.ravel(), kind="stable"), 0
        ends = np.cumsum(np.bincount(cell_of.ravel(), minlength=len(keys)))
        gone = []
        for number in order:
            key = _key(keys[number])
            if freed >= bytes_ or self._last_seen.get(key, 0) == self._instant:
                break
            rows = by_cell[ends[number - 1] if number else 0 : ends[number]]
            self._write(key, take_blocks(self.tsdf, blocks, rows))
            freed += self._bytes_of(int(blocks.dense[rows].sum()), len(rows), each)
            gone.append(blocks.coordinates[rows])
        if gone:
            self.tsdf.erase(np.concatenate(gone))
        return freed

    def _write(self, key: CellKey, arrays: dict[str, np.ndarray]) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        write_bytes(self._path(key), arrays_to_bytes(**arrays))
        self._away[key] = self._decays
        self._last_seen.pop(key, None)
        self.written += 1

    def _path(self, key: CellKey) -> Path:
        return self.folder / f"{key[0]}_{key[1]}_{key[2]}.npz"

    def clear(self) -> None:
        """Forgets what is on disk; the TSDF is cleared by who calls."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._away, self._last_seen, self._wanted, self._decays, self._stale = {}, {}, set(), 0, None


def _key(row: np.ndarray) -> CellKey:
    x, y, z = row.tolist()
    return x, y, z
