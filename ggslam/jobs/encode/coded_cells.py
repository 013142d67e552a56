# SPDX-License-Identifier: Apache-2.0
"""A file of coded cells (see `store_coding`) read again: cell by cell, or as a grid store."""

from __future__ import annotations

import hashlib
import re
import zipfile
from dataclasses import replace
from pathlib import Path

from ggslam.coding import decode_cloud
from ggslam.coding.splats import gaussians_of, is_splat_cloud
from ggslam.errors import ConfigError, FormatError
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS, arrays_of_map, gaussians_to_bytes
from ggslam.jobs.submaps.stores import INDOORS, StoreMakingTuning
from ggslam.runs.records.cells import CellMember, CellsRecord
from ggslam.runs.records.run_json import FileRecord
from ggslam.runs.records.visit import VisitRecord
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.packed_arrays import unpack_bytes
from ggslam.submaps.cell_keys import CellKey, is_coordinate
from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.coming_store import coming_store
from ggslam.submaps.grid import GridStore
from ggslam.submaps.store_objects import StoreObjects, parse_objects, write_objects
from ggslam.submaps.visit_files import write_visit
from ggslam.system.zip_files import ZIP_DAMAGE, open_zip

SUFFIX = ".ggc"
HEAD, OBJECTS, VISIT = "cells.json", "objects.json.xz", "visits/{}.json.xz"
_MEMBER = re.compile(r"cells/(-?\d{1,10})_(-?\d{1,10})_(-?\d{1,10})\.bin", re.ASCII)
_DAMAGE = (*ZIP_DAMAGE, KeyError)


def is_cells_file(path: str | Path) -> bool:
    """Whether a file is called like one."""
    return Path(path).suffix.lower() == SUFFIX


class CodedCells:
    """A file of coded cells, read cell by cell.

    Args:
        path: the file.

    Raises:
        FormatError: it is none, damaged, or of a later version.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with open_zip(path) as archive:
                infos = {info.filename: info for info in archive.infolist()}
                if any(info.compress_type != zipfile.ZIP_STORED for info in infos.values()):
                    raise ValueError("holds compressed members")
                self.head = CellsRecord.parse(archive.read(HEAD))
                told = {**self.head.cells, **self.head.files}
                missing = [name for name, member in told.items() if _size(infos, name) != member.bytes]
        except _DAMAGE as error:
            raise FormatError(f"{path}: no coded cells of ggslam: {error}") from None
        if missing:
            raise FormatError(f"{path}: {missing[0]} is missing or cut off")
        self.members = {key_of(name, path): name for name in self.head.cells}

    def of(self, key: CellKey) -> CellMember:
        """What is told of a cell. Raises KeyError if there is none."""
        return self.head.cells[self.members[key]]

    def read(self, key: CellKey, threads: int | None = None) -> GaussianMap:
        """The Gaussians of a cell.

        Raises:
            KeyError: there is no such cell.
            FormatError: it is damaged.
        """
        name, content = self.members[key], self.content(key)
        try:
            cloud = decode_cloud(content, threads)
        except (FormatError, ConfigError) as error:
            raise FormatError(f"{self.path}: {name}: {error}") from None
        if not is_splat_cloud(cloud):
            raise FormatError(f"{self.path}: {name}: holds no Gaussians")
        return gaussians_of(cloud)


    def content(self, key: CellKey) -> bytes:
        """The stream of a cell; errors as of `read`."""
        return self._content(self.members[key], self.of(key))

    def objects(self) -> StoreObjects | None:
        """What the store knew of objects; None: nothing. Raises FormatError if it is damaged."""
        content = self._file(OBJECTS)
        return None if content is None else parse_objects(content, f"{self.path}: {OBJECTS}")

    def visit(self, number: int) -> bytes | None:
        """What the store remembered of a visit; None: nothing. Raises FormatError if it is damaged."""
        content = self._file(VISIT.format(number))
        if content is not None:
            VisitRecord.parse(content, f"{self.path}: {VISIT.format(number)}")
        return content

    def _file(self, name: str) -> bytes | None:
        if name not in self.head.files:
            return None
        try:
            return unpack_bytes(self._content(name, self.head.files[name]))
        except FormatError as error:
            raise (error if name in str(error) else FormatError(f"{self.path}: {name}: {error}")) from None

    def _content(self, name: str, told: FileRecord) -> bytes:
        try:
            with open_zip(self.path) as archive:
                content = archive.read(name)
        except _DAMAGE as error:
            raise FormatError(f"{self.path}: {name}: {error}") from None
        if hashlib.sha256(content).hexdigest() != told.sha256:
            raise FormatError(f"{self.path}: {name} is damaged: its checksum is not the one in {HEAD}")
        return content


def _size(infos: dict[str, zipfile.ZipInfo], name: str) -> int:
    return infos[name].file_size if name in infos else -1


def key_of(name: str, path: Path) -> CellKey:
    """The cell of a member. Raises FormatError if the name is none of a cell."""
    match = _MEMBER.fullmatch(name)
    if match is None:
        raise FormatError(f"{path}: {name[:80]!r} is no cell")
    x, y, z = (int(number) for number in match.groups())
    if not all(is_coordinate(number) for number in (x, y, z)):
        raise FormatError(f"{path}: {name!r} lies beyond all cells")
    return x, y, z


def decode_store(path: Path, out: Path, threads: int | None = None) -> int:
    """Makes a grid store of a file, with the visits and objects of the one that it came from; returns the number of its
    Gaussians. Positions are rounded, so a few may come to lie on the other side of their cell's border.

    Raises:
        FormatError: the file is none, or damaged.
        RunFolderError: `out` is not empty, or cannot be written.
    """
    cells, count = CodedCells(path), 0
    try:
        settings = replace(INDOORS, spacing=cells.head.spacing, axes=cells.head.axes)
    except ConfigError as error:
        raise FormatError(f"{path}: {error}") from None
    objects, visits = cells.objects(), cells.head.visits
    records = [cells.visit(number) for number in range(len(visits))]  # before anything is written
    by_visit: dict[str, list[CellKey]] = {visit: [] for visit in visits}
    for key in sorted(cells.members):
        by_visit.setdefault(cells.of(key).visit or path.name, []).append(key)
    with coming_store(out) as beside, GridStore.create(beside, settings) as store:
        for number, (visit, keys) in enumerate(by_visit.items()):
            store.begin_visit(visit)
            record = records[number] if number < len(records) else None
            if record is not None:
                write_visit(store, record)
            step = StoreMakingTuning.cells_at_once
            for begin in range(0, len(keys), step):
                writes = [_write_of(cells, key, threads) for key in keys[begin : begin + step]]
                store.put_cells(writes)
                count += sum(write.counts[GAUSSIANS] for write in writes)
        if objects is not None:
            write_objects(store, objects)
    return count


def _write_of(cells: CodedCells, key: CellKey, threads: int | None) -> CellWrite:
    gaussians, told = cells.read(key, threads), cells.of(key)
    data = gaussians_to_bytes(arrays_of_map(gaussians), told.seen_by)
    return CellWrite(key, {GAUSSIANS: data}, told.recorded_at, {GAUSSIANS: len(gaussians)})
