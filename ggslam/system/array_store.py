# SPDX-License-Identifier: Apache-2.0
"""Stores arrays and parts of growing lists once, in numbered files, to which trees of objects (`object_tree`) refer."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.system.array_file import PendingFile, WrittenFile, read_array_file, write_array_file


def kept_name(number: int) -> str:
    """Name of the file of a number."""
    return f"kept-{number:06d}.bin"


class ArrayStore:
    """The numbered files, one of which is being filled. See `object_tree.Keeper` and `object_tree.Kept`.

    Args:
        folder: of the files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.files: dict[int, WrittenFile] = {}
        """By number, those that are whole."""
        self._arrays: dict[int, tuple[weakref.ref[np.ndarray], list[int]]] = {}
        self._lists: dict[int, tuple[list[Any], int, list[list[int]]]] = {}
        self._read: dict[int, tuple[Any, list[np.ndarray]]] = {}
        self._number = -1
        self._begin(0)

    def _begin(self, number: int) -> None:
        self._number = number
        self._new: list[np.ndarray] = []
        self._parts: list[Any] = []
        self._new_arrays: dict[int, tuple[weakref.ref[np.ndarray], list[int]]] = {}
        self._new_lists: dict[int, tuple[list[Any], int, list[list[int]]]] = {}
        self.used: set[int] = set()
        """Files that the trees described since the last `begin` need."""

    # --- writing -----------------------------------------------------------------------------------------------------

    def begin(self, number: int) -> None:
        """From now on what is new is gathered into the file of this number; what was gathered but not written is
        forgotten."""
        self._begin(number)

    def find(self, array: np.ndarray) -> list[int] | None:
        """See `Keeper`."""
        for found in (self._arrays.get(id(array)), self._new_arrays.get(id(array))):
            if found is not None and found[0]() is array:
                self.used.add(found[1][0])
                return found[1]
        return None

    def place(self, array: np.ndarray) -> list[int]:
        """See `Keeper`."""
        place = self.find(array)
        if place is None:
            place = [self._number, len(self._new)]
            self._new.append(array)
            self._new_arrays[id(array)] = (weakref.ref(array), place)
            self.used.add(self._number)
        return place

    def parts(self, items: list[Any], describe: Callable[[Any, Callable[[np.ndarray], int]], Any]) -> list[list[int]]:
        """See `Keeper`."""
        found = self._lists.get(id(items))
        known, places = (found[1], found[2]) if found is not None and found[0] is items else (0, [])
        if len(items) > known:
            places = [*places, [self._number, len(self._parts)]]
            self._parts.append([describe(item, self._append) for item in items[known:]])
        self._new_lists[id(items)] = (items, len(items), places)
        self.used |= {file for file, _ in places}
        return places

    def _append(self, array: np.ndarray) -> int:
        self._new.append(array)
        return len(self._new) - 1

    def write(self) -> PendingFile | None:
        """Writes what was gathered, if anything.

        Raises:
            RunFolderError: the file cannot be written.
        """
        if not self._new and not self._parts:
            return None
        return write_array_file(self._folder / kept_name(self._number), self._parts, self._new)

    def commit(self, file: PendingFile | None) -> None:
        """What was gathered is in its file: it is not written again."""
        if file is not None:
            self.files[self._number] = file.written
        known = {**self._arrays, **self._new_arrays}
        self._arrays = {key: found for key, found in known.items() if found[0]() is not None}
        self._lists = self._new_lists  # lists that are not there any more are forgotten

    # --- reading -----------------------------------------------------------------------------------------------------

    def open(self, files: dict[int, WrittenFile]) -> None:
        """Reads the files of a state.

        Raises:
            FormatError: one is missing or damaged.
        """
        self.files = files
        self._read = {n: read_array_file(self._folder / kept_name(n), expected) for n, expected in files.items()}

    def array(self, file: int, number: int) -> np.ndarray:
        """See `Kept`."""
        array = self._read[file][1][number]
        self._arrays[id(array)] = (weakref.ref(array), [file, number])
        return array

    def part(self, file: int, number: int) -> tuple[Any, Sequence[np.ndarray]]:
        """See `Kept`."""
        values, arrays = self._read[file]
        return values[number], arrays

    def grew(self, items: list[Any], parts: list[list[int]]) -> None:
        """See `Kept`."""
        self._lists[id(items)] = (items, len(items), [list(place) for place in parts])

    def close(self) -> None:
        """All that was asked for was read."""
        self._read = {}
