# SPDX-License-Identifier: Apache-2.0
"""Gaussians on disk: rows of a map in the cells of a grid store, by the position of their means.

Rows move as they are, with optimizer state, votes and births, and come back bit for bit. Which cells hold how many of
them and how far they reach is kept in memory; the store itself is asked for contents only.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from ggslam.geometry.frustums import Frustums
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.gaussian_rows import Rows, decode_rows, encode_rows, join, map_like
from ggslam.submaps.grid import GridStore
from ggslam.system.tuning import Tuning

PART, ARRIVALS = "gaussians.rows", "arrivals.rows"
"""Parts of a cell: its Gaussians, and while a correction is carried out those that come from other cells."""
REACH_SIGMAS: Final = 3.4
"""Standard deviations to which a Gaussian reaches: beyond, its alpha is below 1/255 at any opacity."""


class GaussianCellTuning(Tuning):
    """Gaussians in cells."""

    batch_bytes = 1 << 22
    """Bytes of encoded cells that are written together."""
    block = 1 << 16
    """Gaussians that are sorted into cells in one batch."""


_BITS: Final = 20
"""Bits of a cell's coordinate in a key."""
_HALF = 1 << (_BITS - 1)
_NOWHERE = (-_HALF, -_HALF, -_HALF)
"""Gaussians that are more than half a million cells from the origin, or at no place at all: they stay in memory until
they are pruned."""


@dataclass(frozen=True)
class _Held:
    """What is known of a cell on disk: rows, corners of the box they reach to [3], and the keyframes they came from."""

    count: int
    low: np.ndarray
    high: np.ndarray
    births: np.ndarray


class GaussianCells:
    """Rows of one map on disk.

    Args:
        store: open for writing, for nothing else.
        like: the map; tells the channels of the rows.
    """

    def __init__(self, store: GridStore, like: GaussianMap) -> None:
        self.store = store
        self._like = map_like(like)
        self._cells: dict[CellKey, _Held] = {}
        self._emptied: set[CellKey] = set()
        self.bytes_written = 0
        self.count = 0
        """Gaussians on disk."""

    def count_in(self, keys: Iterable[CellKey]) -> int:
        """Gaussians on disk in some cells."""
        return sum(self._cells[key].count for key in keys if key in self._cells)

    def sorted_keys(self) -> list[CellKey]:
        """Cells that have Gaussians on disk, sorted."""
        return sorted(self._cells)

    def visible_cells(self, frustums: Frustums) -> list[list[CellKey]]:
        """Of each camera, the cells on disk with Gaussians that it may see, sorted."""
        keys = self.sorted_keys()
        if not keys:
            return [[] for _ in frustums.offsets]
        low, high = (np.stack([getattr(self._cells[key], side) for key in keys]) for side in ("low", "high"))
        return [[keys[i] for i in np.flatnonzero(row)] for row in frustums.touch(low, high)]

    # --- between memory and disk -------------------------------------------------------------------------------------

    def cells_of(self, gaussians: GaussianMap) -> dict[CellKey, np.ndarray]:
        """The rows of a map in memory by cell, int64 [n] each, rising."""
        packed = self._pack(gaussians.means.numpy())
        order = np.argsort(packed, kind="stable")
        packed = packed[order]
        starts = np.flatnonzero(np.diff(packed, prepend=-1))
        groups = np.split(order, starts[1:]) if len(order) else []
        rows = {_key_of(packed[start]): index for start, index in zip(starts, groups, strict=True)}
        rows.pop(_NOWHERE, None)
        return rows

    @staticmethod
    def boxes_of(gaussians: GaussianMap, rows: Mapping[CellKey, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Corners float64 [cells, 3] of the boxes that the Gaussians of cells in memory reach to, metres."""
        order = np.concatenate(list(rows.values()))
        starts = np.cumsum([0, *(len(index) for index in rows.values())])[:-1]
        means, reach = gaussians.means.numpy()[order], _reach(gaussians.log_scales.numpy()[order])
        return (
            np.minimum.reduceat(means - reach, starts).astype(np.float64),
            np.maximum.reduceat(means + reach, starts).astype(np.float64),
        )

    def _pack(self, means: np.ndarray) -> np.ndarray:
        """The cell of each mean as one number, a block at a time: the map may take most of the memory there is."""
        out = np.empty(len(means), np.int64)
        reach = _HALF * self.store.grid.spacing * 0.99
        for begin in range(0, len(means), GaussianCellTuning.block):
            block = means[begin : begin + GaussianCellTuning.block]
            inside = (np.abs(block) < reach).all(1)
            keys = self.store.grid.keys_of(np.where(inside[:, None], block, 0)) + _HALF
            numbers = (keys[:, 0] << 2 * _BITS) | (keys[:, 1] << _BITS) | keys[:, 2]
            out[begin : begin + GaussianCellTuning.block] = np.where(inside, numbers, 0)
        return out

    def move_out(self, gaussians: GaussianMap, rows: Mapping[CellKey, np.ndarray]) -> int:
        """Moves rows to disk; returns how many. Those of a cell leave the map when they are written, so that all there
        are is in one place also if the disk is full.

        Args:
            gaussians: the map.
            rows: by cell, as `cells_of` gave them.

        Raises:
            RunFolderError: they cannot be written; cells that were not are in the map.
        """
        written: list[CellKey] = []
        try:
            self._write(((key, gaussians.take(torch.from_numpy(i))) for key, i in rows.items()), written=written)
        finally:
            stays = torch.ones(len(gaussians), dtype=torch.bool)
            for key in written:
                stays[torch.from_numpy(rows[key])] = False
            moved = gaussians.keep(stays)
        return moved

    def move_in(self, gaussians: GaussianMap, keys: Iterable[CellKey]) -> slice:
        """Brings the Gaussians of cells back, in the order of `sorted_keys`; returns the rows they have now."""
        begin = len(gaussians)
        for key in keys:
            gaussians.append(self._rows(key))
            self._forget(key)
        return slice(begin, len(gaussians))

    def remove_emptied(self) -> None:
        """Removes cells from the store whose Gaussians are now all in memory or in other cells."""
        for key in sorted(self._emptied):
            self.store.remove(key)
        self._emptied.clear()

    # --- on disk -----------------------------------------------------------------------------------------------------

    def read(self, key: CellKey) -> GaussianMap:
        """The Gaussians of a cell as a map of their own."""
        return map_like(self._like, self._rows(key))

    def change(
        self, change: Callable[[GaussianMap], None], births: Collection[int] | None = None
    ) -> None:
        """Changes the Gaussians on disk, cell by cell. Those that are moved by it go to the cells they are in then.

        Args:
            change: of a cell's Gaussians; it may move them but not add or remove any.
            births: only cells with Gaussians of these keyframes; None: all.
        """
        wanted = None if births is None else np.array(sorted(births))
        chosen = [key for key in self.sorted_keys() if wanted is None or np.isin(self._cells[key].births, wanted).any()]
        waiting: set[CellKey] = set()
        for key in chosen:
            gaussians = self.read(key)
            change(gaussians)
            stay: Rows | None = None
            for place, index in self.cells_of(gaussians).items():
                rows = gaussians.take(torch.from_numpy(index))
                if place == key:
                    stay = rows
                else:  # not among those that are there already: their cell may still have to be changed
                    self._add_arrivals(place, rows, place in waiting)
                    waiting.add(place)
            self._forget(key)
            if stay is not None:
                self._write([(key, stay)])
        for place in sorted(waiting):
            rows = decode_rows(self.store.get(place, ARRIVALS), self._name(place))
            self._write([(place, rows)], {ARRIVALS: b""})

    def _add_arrivals(self, key: CellKey, rows: Rows, more: bool) -> None:
        if more:
            rows = join([decode_rows(self.store.get(key, ARRIVALS), self._name(key)), rows])
        self.store.put(key, {ARRIVALS: encode_rows(rows)})

    def box(self, key: CellKey) -> tuple[np.ndarray, np.ndarray]:
        """Corners float64 [3] of the box that a cell's Gaussians on disk reach to, metres."""
        return self._cells[key].low, self._cells[key].high

    def parts(self) -> Iterator[tuple[CellKey, GaussianMap]]:
        """All Gaussians on disk, cell by cell in the order of `sorted_keys`."""
        for key in self.sorted_keys():
            yield key, self.read(key)

    # --- parts -------------------------------------------------------------------------------------------------------

    def _rows(self, key: CellKey) -> Rows:
        return decode_rows(self.store.get(key, PART), self._name(key))

    def _name(self, key: CellKey) -> str:
        return f"{self.store.path}: cell {key}"

    def _forget(self, key: CellKey) -> None:
        self.count -= self._cells.pop(key).count
        self._emptied.add(key)

    def _write(
        self, cells: Iterable[tuple[CellKey, Rows]], others: Mapping[str, bytes] | None = None,
        written: list[CellKey] | None = None,
    ) -> None:  # fmt: skip
        """Adds rows to cells, many of them at a time; `written` is told which, as they are."""
        batch: list[tuple[CellWrite, _Held]] = []
        size = 0
        for key, added in cells:
            rows = join([self._rows(key), added]) if key in self._cells else added
            data = encode_rows(rows)
            held = _summarise(rows)
            batch.append((CellWrite(key, {PART: data, **(others or {})}, counts={PART: held.count}), held))
            size += len(data)
            if size > GaussianCellTuning.batch_bytes:
                self._put(batch, written)
                batch, size = [], 0
        self._put(batch, written)

    def _put(self, batch: list[tuple[CellWrite, _Held]], written: list[CellKey] | None) -> None:
        self.store.put_cells([write for write, _ in batch])
        for write, held in batch:
            self.bytes_written += len(write.parts[PART])
            self.count += held.count - (self._cells[write.key].count if write.key in self._cells else 0)
            self._cells[write.key] = held
            self._emptied.discard(write.key)
            if written is not None:
                written.append(write.key)


def _key_of(number: int) -> CellKey:
    limit = (1 << _BITS) - 1
    number = int(number)
    return (number >> 2 * _BITS) - _HALF, ((number >> _BITS) & limit) - _HALF, (number & limit) - _HALF


def _summarise(rows: Rows) -> _Held:
    means, reach = rows["means"].numpy(), _reach(rows["log_scales"].numpy())
    low, high = (means - reach).min(0).astype(np.float64), (means + reach).max(0).astype(np.float64)
    return _Held(len(means), low, high, np.unique(rows["birth_keyframe"].numpy()))


def _reach(log_scales: np.ndarray) -> np.ndarray:
    """Metres that Gaussians reach, float32 [N, 1]."""
    return REACH_SIGMAS * np.exp(log_scales.max(1, keepdims=True).clip(-20, 5))
