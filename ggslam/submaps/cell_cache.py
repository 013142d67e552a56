# SPDX-License-Identifier: Apache-2.0
"""Caches decoded cells within a fixed number of bytes: the least recently used cell is dropped first."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from typing import Generic, TypeVar

from ggslam.submaps.cell_points import CellArrays


def byte_count(arrays: CellArrays) -> int:
    """Bytes that the values of a cell's arrays take."""
    return sum(values.nbytes for values in arrays.values())


Cell = TypeVar("Cell")


class CellCache(Generic[Cell]):
    """A cache that threads share. Two that want the same cell wait for one loading of it.

    Args:
        limit: bytes. Cells that are larger alone are handed out but not kept.
        size: gives the bytes of a cell.
    """

    def __init__(self, limit: int, size: Callable[[Cell], int]) -> None:
        self.limit = limit
        self._size = size
        self.bytes = 0
        """Of the cells held now."""
        self.peak_bytes = 0
        """The most that `bytes` ever was."""
        self._cells: OrderedDict[Hashable, Cell] = OrderedDict()
        self._loading: dict[Hashable, Future[Cell]] = {}
        self._lock = threading.Lock()

    def __contains__(self, key: Hashable) -> bool:
        with self._lock:
            return key in self._cells

    def get(self, key: Hashable, load: Callable[[], Cell]) -> Cell:
        """The cell of this key, from memory or else from `load`, whose errors are passed on."""
        with self._lock:
            if key in self._cells:
                self._cells.move_to_end(key)
                return self._cells[key]
            waiting = self._loading.get(key)
            if waiting is None:
                loading = self._loading[key] = Future()
        if waiting is not None:
            return waiting.result()
        try:
            cell = load()
        except BaseException as error:
            with self._lock:
                del self._loading[key]
            loading.set_exception(error)
            raise
        with self._lock:
            del self._loading[key]
            self._keep(key, cell)
        loading.set_result(cell)
        return cell

    def clear(self) -> None:
        """Forgets every cell."""
        with self._lock:
            self._cells.clear()
            self.bytes = 0

    def _keep(self, key: Hashable, cell: Cell) -> None:
        size = self._size(cell)
        if size > self.limit:
            return
        while self.bytes + size > self.limit:
            self.bytes -= self._size(self._cells.popitem(last=False)[1])
        self._cells[key] = cell
        self.bytes += size
        self.peak_bytes = max(self.peak_bytes, self.bytes)
