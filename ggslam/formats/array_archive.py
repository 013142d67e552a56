# SPDX-License-Identifier: Apache-2.0
"""Arrays that never change (images, points), stored in files; the last used ones are kept in memory up to a limit."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ggslam.scene.arrays import arrays_to_bytes, read_all_arrays
from ggslam.system.atomic import make_folder, write_bytes

Arrays = Mapping[str, np.ndarray]


class ArrayArchive:
    """Named sets of arrays; threads may share it. A set is written to disk when it has to leave memory for the first
    time; as long as all sets fit, no file is made.

    Args:
        folder: for the files; made when the first one is written.
        limit: bytes of arrays held in memory; infinite to begin with.
    """

    def __init__(self, folder: Path, limit: float = float("inf")) -> None:
        self.folder = folder
        self.bytes_on_disk = 0
        self._limit = limit
        self._held: OrderedDict[str, Arrays] = OrderedDict()
        self._bytes = 0
        self._written: set[str] = set()
        self._lock = threading.RLock()

    @property
    def limit(self) -> float:
        """Bytes of arrays held in memory at most; the set used last is held in any case."""
        return self._limit

    @limit.setter
    def limit(self, limit: float) -> None:
        with self._lock:
            self._limit = limit
            self._make_room()

    @property
    def held_bytes(self) -> int:
        """Bytes of arrays held in memory."""
        return self._bytes

    def put(self, name: str, arrays: Arrays) -> None:
        """Adds a set; its arrays must not be changed any more.

        Raises:
            RunFolderError: a set that had to leave memory cannot be written.
        """
        with self._lock:
            self._hold(name, arrays)

    def get(self, name: str) -> Arrays:
        """A set that was put.

        Raises:
            KeyError: it was not.
            FormatError: its file was damaged.
        """
        with self._lock:
            if name in self._held:
                self._held.move_to_end(name)
                return self._held[name]
            if name not in self._written:
                raise KeyError(name)
            arrays = read_all_arrays(self._path(name), "arrays of a run")
            self._hold(name, arrays)
            return arrays

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"

    def _hold(self, name: str, arrays: Arrays) -> None:
        self._held[name] = arrays
        self._bytes += _size(arrays)
        self._make_room()

    def _make_room(self) -> None:
        while self._bytes > self._limit and len(self._held) > 1:
            name, arrays = next(iter(self._held.items()))
            if name not in self._written:
                make_folder(self.folder)
                data = arrays_to_bytes(**arrays)
                write_bytes(self._path(name), data)
                self._written.add(name)
                self.bytes_on_disk += len(data)
            del self._held[name]
            self._bytes -= _size(arrays)


def _size(arrays: Arrays) -> int:
    return sum(array.nbytes for array in arrays.values())
