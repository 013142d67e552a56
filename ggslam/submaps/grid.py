# SPDX-License-Identifier: Apache-2.0
"""The grid store: a map on disk, divided into cells whose parts (points, Gaussians, features, places) are written
together.

    map.grid/
        index.sqlite                  what there is (index.py): settings, visits, cells, parts with size and CRC-32
        lock                          held by the one writer
        cells/3_0_-2/17/points.pcd    cell (3, 0, -2), a part written with version 17 (cell_files.py)
        visits/                       what is remembered of visits (visit_files.py)
        objects.json                  the objects that visits found (store_objects.py)

Units: metres in world coordinates, seconds on the clock of the recordings, sizes in bytes.

A write puts files into a new folder, waits for the disk, and makes them current by one transaction of the index; only
then the files they replace go. A program killed at any moment, or a power cut, leaves each cell as it was or as it was
to be.
"""

from __future__ import annotations

import math
import os
import secrets
import threading
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType

import numpy as np

from ggslam.errors import ConfigError, FormatError, RunFolderError
from ggslam.submaps.cell_files import CellFiles, WriterLock, is_locked, read_current, wait_for_disk
from ggslam.submaps.cell_keys import CellKey, Grid
from ggslam.submaps.cell_records import CellChange, CellRecord, CellWrite, PartRecord
from ggslam.submaps.index import CellIndex
from ggslam.submaps.settings import SubmapSettings
from ggslam.system.atomic import make_folder, write_failure

INDEX, CELLS = "index.sqlite", "cells"
_LOCK = "lock"


class GridStore:
    """A map on disk; `create` and `open` give one. Threads may share it, processes open it each for themselves.

    One writer at a time, beside any number of readers, which see what was complete when they look.
    """

    def __init__(self, path: Path, index: CellIndex, settings: SubmapSettings, lock: WriterLock | None) -> None:
        self.path = path
        self.settings = settings
        self.grid = Grid(settings.spacing, settings.axes)
        self.visit: str | None = None
        """The visit that writes belong to; see `begin_visit`."""
        self._index = index
        self._lock = lock
        self._files = CellFiles(path / CELLS)
        self._last_version = index.last_version()
        self._visit_number: int | None = None
        self._writing = threading.RLock()
        self._clean = True
        """Whether every folder of files is one that the index speaks of."""
        if lock is not None and lock.unfinished:
            self._sweep_all()

    @classmethod
    def create(cls, path: str | Path, settings: SubmapSettings | None = None) -> GridStore:
        """Makes an empty store and opens it for writing.

        Raises:
            RunFolderError: the folder is there and not empty, or cannot be written.
        """
        path = Path(path)
        make_folder(path)
        try:
            others = [entry.name for entry in path.iterdir() if not entry.name.startswith(".index-")]
        except OSError as error:
            raise write_failure(path, error) from error
        if others:
            raise RunFolderError(
                f"{path}: is not empty (it holds {sorted(others)[0]}): a new store needs a folder of its own"
            )
        temporary = path / f".index-{os.getpid()}-{secrets.token_hex(4)}"
        try:
            CellIndex.create(temporary, settings or SubmapSettings())
            temporary.replace(path / INDEX)
        except OSError as error:
            raise write_failure(path / INDEX, error) from error
        finally:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
        wait_for_disk(path.parent)
        return cls.open(path, write=True)

    @classmethod
    def open(cls, path: str | Path, write: bool = False, settings: SubmapSettings | None = None) -> GridStore:
        """Opens a store. Opening it for writing clears away what a writer that was killed left unfinished.

        Args:
            path: its folder.
            write: whether cells are to be written.
            settings: take the place of those the store was created with, while it is open.

        Raises:
            FormatError: no store, damaged, or of another version.
            ConfigError: `settings` have another grid (spacing, axes) than the store.
            RunFolderError: another process writes to it, or the folder cannot be opened.
        """
        path = Path(path)
        if not (path / INDEX).is_file():
            raise FormatError(f"{path}: no grid store: there is no file {INDEX}")
        for entry in path.iterdir():
            if entry.is_symlink():
                raise FormatError(f"{entry}: is a link; a store holds none")
        with ExitStack() as undone:
            lock = None
            if write:
                lock = WriterLock(path / _LOCK)
                undone.callback(lock.abandon)
                if not (path / CELLS).is_dir():
                    make_folder(path / CELLS)
                    wait_for_disk(path)
            index, own = CellIndex.open(path / INDEX, write)
            undone.callback(index.close)
            if settings is not None:
                check_same_grid(path, own, settings)
            store = cls(path, index, settings or own, lock)
            undone.pop_all()
            return store

    def close(self) -> None:
        """Lets the next writer in. The store cannot be used any more."""
        self._index.close()
        if self._lock is not None:
            self._lock.release() if self._clean else self._lock.abandon()
            self._lock = None

    def __enter__(self) -> GridStore:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # Where things are

    def key_of(self, position: np.ndarray) -> CellKey:
        """The cell that a position [3] (metres, world) lies in."""
        return self.grid.key_of(position)

    def centre_of(self, key: CellKey) -> np.ndarray:
        """Centre of a cell, float64 [3] in metres; 0 along axes that the grid does not span."""
        return self.grid.centres_of(np.array(key))[0]

    def near(self, position: np.ndarray, radius: float) -> list[CellKey]:
        """Cells of the store whose centres lie within `radius` metres of a position [3], nearest first."""
        return list(self._near(position, radius, None))

    def part_versions(self, part: str, position: np.ndarray, radius: float) -> dict[CellKey, int]:
        """Like `near`, for cells that have a part, with the version that it was written with."""
        return self._near(position, radius, part)

    def around(self, key: CellKey, part: str, steps: int) -> list[CellKey]:
        """Cells that have a part, at most so many cells from one along every axis, sorted; itself among them."""
        reach = steps * self.grid.spacing * math.sqrt(3) * 1.01
        near = self.part_versions(part, self.centre_of(key), reach)
        return sorted(other for other in near if max(abs(a - b) for a, b in zip(key, other, strict=True)) <= steps)

    def _near(self, position: np.ndarray, radius: float, part: str | None) -> dict[CellKey, int]:
        position = np.asarray(position, np.float64)
        self.key_of(position)  # refuses positions that are not finite
        versions = self._index.in_box(*self.grid.box(position, radius), part)
        keys = list(versions)
        if not keys:
            return {}
        distances = self.grid.distances(np.array(keys), position)
        nearest = [i for i in np.argsort(distances, kind="stable").tolist() if distances[i] <= radius]
        return {keys[i]: versions[keys[i]] for i in nearest}

    # What is there

    def cells(self) -> list[CellKey]:
        """Every cell, sorted."""
        return self._index.keys()

    def counts(self, part: str) -> dict[CellKey, int]:
        """The cells that have a part, sorted, with its number of entries."""
        found = ((key, self.cell(key).parts.get(part)) for key in self.cells())
        return {key: record.count for key, record in found if record is not None}

    def cell(self, key: CellKey) -> CellRecord:
        """What is known of a cell. Raises KeyError if there is none, FormatError if one that is listed is not found."""
        record = self._index.record(key)
        if record is None:
            self._index.check_absent(key)
            raise KeyError(f"{self.path} has no cell {key}")
        return record

    def __contains__(self, key: CellKey) -> bool:
        return self._index.record(key) is not None

    def problems(self) -> Iterator[str]:
        """What is wrong with the files of parts as far as their sizes tell, each in a line with the file's name."""
        for key in self.cells():
            for name, part in self.cell(key).parts.items():
                path = self._files.path(key, part.version, name)
                try:
                    size = path.stat().st_size
                except OSError as error:
                    yield f"cannot read {path}: {error.strerror or error}"
                else:
                    if size != part.bytes:
                        yield f"{path}: damaged: {size} bytes, the index says {part.bytes}"

    def get(self, key: CellKey, part: str) -> bytes:
        """The content of a part.

        Raises:
            KeyError: there is no such cell, or it has no such part.
            FormatError: the file is missing, damaged or cannot be read; names it and the reason. Others stay usable.
        """
        found: list[PartRecord] = []

        def find() -> tuple[Path, int]:
            record = self._index.part(key, part)
            if record is None:
                if part in self.cell(key).parts:
                    raise FormatError(f"{self.path / INDEX}: damaged: cell {key}: its part {part!r} is not found")
                raise KeyError(f"{self.path}: cell {key} has no part {part!r}")
            found.append(record)
            return self._files.path(key, record.version, part), record.bytes

        try:
            path, data = read_current(find)
        except OSError as error:
            path = self._files.path(key, found[-1].version, part)
            raise FormatError(f"cannot read {path}: {error.strerror or error}") from error
        if zlib.crc32(data) != found[-1].crc:
            raise FormatError(f"{path}: damaged: its checksum is not the one in the index")
        return data

    def due(self, key: CellKey, now: float, refresh: float | None = None) -> bool:
        """Whether a cell was never recorded, or longer ago than `refresh` seconds (None: T of the settings)."""
        record = self._index.record(key)
        wait = self.settings.refresh if refresh is None else refresh
        return record is None or record.recorded_at is None or now - record.recorded_at > wait

    # Writing

    def begin_visit(self, name: str) -> None:
        """Writes from now on belong to this visit; a name that is known goes on with that visit."""
        self._check_writable()
        with self._writing:
            self._visit_number = self._index.add_visit(name)
            self.visit = name

    def put(
        self,
        key: CellKey,
        parts: Mapping[str, bytes],
        recorded_at: float | None = None,
        counts: Mapping[str, int] | None = None,
        changed: float | None = None,
    ) -> None:
        """Writes parts of one cell: when this returns they are on the disk. See `CellWrite` and `put_cells`."""
        self.put_cells([CellWrite(key, parts, recorded_at, counts or {}, changed)])

    def put_cells(self, writes: Sequence[CellWrite]) -> None:
        """Writes cells, each at most once, all or none of them; together they wait for the disk less than one by one.

        Raises:
            RunFolderError: the store is open for reading only, the disk is full, ... The store is as it was.
            ValueError: the name of a part is no plain file name.
            ConfigError: a time, a share or a number is none that a store may hold.
        """
        self._check_writable()
        if not writes:
            return
        self._index.check(writes)
        sizes = [{name: (len(data), zlib.crc32(data)) for name, data in write.parts.items()} for write in writes]
        with self._writing:
            versions = range(self._last_version + 1, self._last_version + 1 + len(writes))
            self._last_version = versions[-1]
            clean, self._clean = self._clean, False
            try:
                self._files.write({(w.key, v): w.parts for w, v in zip(writes, versions, strict=True)})
                self._index.commit(list(zip(writes, versions, sizes, strict=True)), self._visit_number)
            finally:  # whether it went well or not, the index says what to keep
                for write in writes:
                    self._sweep(write.key)
            self._clean = clean

    def remove(self, key: CellKey) -> None:
        """Removes a cell and everything in it; no error if there is none."""
        self._check_writable()
        with self._writing:
            self._index.remove(key)
            self._sweep(key)

    def remove_part(self, key: CellKey, part: str) -> None:
        """Removes a part of a cell; no error if there is none."""
        self._check_writable()
        with self._writing:
            self._index.remove_part(key, part)
            self._sweep(key)

    def changed_since(self, visit: str) -> list[CellChange]:
        """Cells that a visit, or one after it, added or refreshed, with the greatest share that changed, sorted.

        Raises:
            ConfigError: there was no such visit.
        """
        number = self._index.visit_number(visit)
        if number is None:
            known = ", ".join(self._index.visits()) or "none"
            raise ConfigError(f"{self.path}: no visit {visit!r}; there are: {known}")
        return self._index.changes(number)

    def visits(self) -> list[str]:
        """Names of the visits, oldest first."""
        return self._index.visits()

    def copy_index(self, path: Path) -> None:
        """Writes the index as it is now to a new file."""
        self._index.copy(path)

    def _check_writable(self) -> None:
        if self._lock is None:
            raise RunFolderError(f"{self.path}: is open for reading only")

    def _sweep(self, key: CellKey) -> None:
        record = self._index.record(key)
        self._files.sweep(key, {name: part.version for name, part in record.parts.items()} if record else {})

    def _sweep_all(self) -> None:
        for key in self._files.cells():
            self._sweep(key)


def is_being_written(path: Path) -> bool:
    """Whether somebody, perhaps this process, has the store at `path` open for writing: its lock tells, not the number
    in it, which may since be another process's."""
    return is_locked(path / _LOCK)


def check_same_grid(path: Path, own: SubmapSettings, wanted: SubmapSettings) -> None:
    """Raises ConfigError if two settings cut the world into different cells."""
    if (own.spacing, own.axes) != (wanted.spacing, wanted.axes):
        raise ConfigError(
            f"{path}: its cells are {own.spacing:g} m along {own.axes}, the settings say {wanted.spacing:g} m along "
            f"{wanted.axes}"
        )
