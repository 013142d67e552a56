# SPDX-License-Identifier: Apache-2.0
"""A grid store's Gaussians in one file, coded cell by cell: `ggslam encode STORE map.ggc`.

A zip archive whose members are stored as they are, so that a reader takes the cells that it needs:

    cells.json          see `runs.records.cells.CellsRecord`: grid, quality; of each cell Gaussians, bytes and SHA-256
    cells/3_0_-2.bin    a G-PCC stream of the Gaussians of cell (3, 0, -2); `ggslam decode` reads it, too

All cells are coded on steps of one length, that of coding all Gaussians at once but the few outermost.
"""

from __future__ import annotations

import hashlib
import re
import tempfile
import time
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ggslam import __version__
from ggslam.coding import CodecSettings, decode_cloud, encode_cloud
from ggslam.coding.outliers import SAMPLED, bulk_of
from ggslam.coding.splats import (
    POSITION_BITS,
    gaussians_of,
    is_splat_cloud,
    means_of,
    rest_range,
    splat_attributes,
    splat_settings,
)
from ggslam.errors import ConfigError, FormatError
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.submaps.cell_gaussians import (
    GAUSSIANS,
    arrays_of_map,
    gaussians_from_bytes,
    gaussians_to_bytes,
    map_of_arrays,
)
from ggslam.jobs.submaps.stores import INDOORS
from ggslam.jobs.tasks.engines import Engine
from ggslam.jobs.tasks.outcomes import Failure
from ggslam.jobs.tasks.processors import own_threads
from ggslam.runs.records.cells import CELLS_FORMAT, CELLS_VERSION, CellMember, CellsRecord
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.grid import GridStore
from ggslam.system.atomic import atomic_write, make_folder, write_bytes
from ggslam.system.foreign import open_foreign

SUFFIX = ".ggc"
_HEAD = "cells.json"
_MEMBER = re.compile(r"cells/(-?\d+)_(-?\d+)_(-?\d+)\.bin")
_CELLS_AT_ONCE = 64
_DAMAGE = (OSError, zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, ValueError, KeyError)


@dataclass(frozen=True)
class CodeTask:
    """A cell to code: its part with Gaussians, and how."""

    key: CellKey
    name: str
    data: bytes
    rate: str
    settings: CodecSettings


@dataclass
class CodedStore:
    """A written file: Gaussians in it, bytes of them in the store, bytes by cell, cells that could not be coded and
    why, and seconds."""

    path: Path
    gaussians: int = 0
    store_bytes: int = 0
    sizes: dict[CellKey, int] = field(default_factory=dict)
    failures: dict[CellKey, str] = field(default_factory=dict)
    seconds: float = 0.0


def is_cells_file(path: str | Path) -> bool:
    """Whether a file is called like one."""
    return Path(path).suffix.lower() == SUFFIX


def encode_cell(task: CodeTask) -> bytes:
    """The stream of a cell. Raises FormatError if its Gaussians are damaged."""
    gaussians = map_of_arrays(gaussians_from_bytes(task.data, task.name)[0])
    rest = rest_range([gaussians])
    attributes = splat_attributes(gaussians, with_ids=True, rest=rest)
    settings = splat_settings(replace(task.settings, threads=own_threads()), task.rate, attributes, rest)
    return encode_cloud(means_of(gaussians), attributes, settings).data


def encode_store(
    path: Path, out: Path, rate: str = "r03", settings: CodecSettings | None = None, engine: Engine | None = None,
    observer: Observer | None = None,
) -> CodedStore:  # fmt: skip
    """Codes the Gaussians of a store; the bytes do not depend on the number of workers.

    Args:
        path: of the store.
        out: the file.
        rate: r01 (smallest) to r04.
        settings: slices of each cell, tools; a voxel size takes the place of the one that the store's extent gives.
        engine: where; None: on this machine.
        observer: receives progress updates.

    Raises:
        ConfigError: it has no Gaussians, or no such rate.
        GgslamError: it is no store, or the file cannot be written. (Damaged cells are left out and told.)
    """
    start, chosen = time.perf_counter(), settings or CodecSettings()
    make_folder(out.parent)
    with GridStore.open(path) as store, tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.stem}-") as folder:
        coding = _Coding(store, Path(folder), CodedStore(out), observer or SilentObserver())
        if not coding.counts:
            raise ConfigError(f"{path}: has no Gaussians to code; stores made of runs have some")
        if chosen.voxel_size is None:
            chosen = replace(chosen, voxel_size=_step(store, coding.counts))
        coding.observer.begin("encode", len(coding.counts))
        (engine or Engine()).do(encode_cell, coding.tasks(rate, chosen), coding.take)
        coding.join(rate)
    coding.outcome.seconds = time.perf_counter() - start
    return coding.outcome


@dataclass
class _Coding:
    """A store being coded, each cell into a file of a folder first."""

    store: GridStore
    folder: Path
    outcome: CodedStore
    observer: Observer
    counts: dict[CellKey, int] = field(default_factory=dict)
    members: dict[CellKey, CellMember] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key in self.store.cells():
            part = self.store.cell(key).parts.get(GAUSSIANS)
            if part is not None and part.count:
                self.counts[key] = part.count

    def tasks(self, rate: str, settings: CodecSettings) -> Iterator[CodeTask]:
        """The cells; damaged ones are noted."""
        for key in sorted(self.counts):
            try:
                data = self.store.get(key, GAUSSIANS)
            except FormatError as error:
                self.outcome.failures[key] = str(error)
                continue
            self.outcome.store_bytes += len(data)
            yield CodeTask(key, f"{self.store.path}: cell {key}: no Gaussians written by ggslam", data, rate, settings)

    def take(self, task: CodeTask, found: bytes | Failure) -> None:
        """A cell was coded, or could not be."""
        if isinstance(found, Failure):
            self.outcome.failures[task.key] = found.line
        else:
            write_bytes(self.folder / _file_of(task.key), found)
            self.members[task.key] = CellMember(
                gaussians=self.counts[task.key], bytes=len(found), sha256=hashlib.sha256(found).hexdigest()
            )
        self.observer.advance(len(self.members) + len(self.outcome.failures), len(self.counts))

    def join(self, rate: str) -> None:
        """Writes the file."""
        if not self.members:
            raise FormatError(next(iter(self.outcome.failures.values())))
        keys, own = sorted(self.members), self.store.settings
        head = CellsRecord(
            format=CELLS_FORMAT, version=CELLS_VERSION, ggslam=__version__, rate=rate, spacing=own.spacing,
            axes=own.axes, cells={f"cells/{_file_of(key)}": self.members[key] for key in keys},
        )  # fmt: skip
        with atomic_write(self.outcome.path) as path, zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            archive.writestr(zipfile.ZipInfo(_HEAD), head.model_dump_json(indent=1))
            for key in keys:
                archive.writestr(zipfile.ZipInfo(f"cells/{_file_of(key)}"), (self.folder / _file_of(key)).read_bytes())
        self.outcome.sizes = {key: self.members[key].bytes for key in keys}
        self.outcome.gaussians = sum(member.gaussians for member in self.members.values())


def _file_of(key: CellKey) -> str:
    return f"{key[0]}_{key[1]}_{key[2]}.bin"


def _step(store: GridStore, counts: dict[CellKey, int]) -> float:
    """Edge of the voxels: that of a grid of `POSITION_BITS` over the cells, but those of a few Gaussians far away."""
    keys = np.array(list(counts))
    numbers = np.maximum(1, np.array(list(counts.values())) // max(1, sum(counts.values()) // SAMPLED))
    extent = (np.ptp(bulk_of(np.repeat(keys, numbers, axis=0)), axis=0) + 1)[store.grid.spans].max()
    return float(extent * store.grid.spacing) / (1 << POSITION_BITS)


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
            with open_foreign(path) as file, zipfile.ZipFile(file) as archive:
                infos = {info.filename: info for info in archive.infolist()}
                if any(info.compress_type != zipfile.ZIP_STORED for info in infos.values()):
                    raise ValueError("holds compressed members")
                self.head = CellsRecord.parse(archive.read(_HEAD))
                missing = [name for name, member in self.head.cells.items() if _size(infos, name) != member.bytes]
        except _DAMAGE as error:
            raise FormatError(f"{path}: no coded cells of ggslam: {error}") from None
        if missing:
            raise FormatError(f"{path}: {missing[0]} is missing or cut off")
        self.members = {key_of(name, path): name for name in self.head.cells}

    def read(self, key: CellKey, threads: int | None = None) -> GaussianMap:
        """The Gaussians of a cell.

        Raises:
            KeyError: there is no such cell.
            FormatError: it is damaged.
        """
        name = self.members[key]
        try:
            with open_foreign(self.path) as file, zipfile.ZipFile(file) as archive:
                content = archive.read(name)
        except _DAMAGE as error:
            raise FormatError(f"{self.path}: {name}: {error}") from None
        if hashlib.sha256(content).hexdigest() != self.head.cells[name].sha256:
            raise FormatError(f"{self.path}: {name} is damaged: its checksum is not the one in {_HEAD}")
        try:
            cloud = decode_cloud(content, threads)
        except (FormatError, ConfigError) as error:
            raise FormatError(f"{self.path}: {name}: {error}") from None
        if not is_splat_cloud(cloud):
            raise FormatError(f"{self.path}: {name}: holds no Gaussians")
        return gaussians_of(cloud)


def _size(infos: dict[str, zipfile.ZipInfo], name: str) -> int:
    return infos[name].file_size if name in infos else -1


def key_of(name: str, path: Path) -> CellKey:
    """The cell of a member. Raises FormatError if the name is none of a cell."""
    match = _MEMBER.fullmatch(name)
    if match is None:
        raise FormatError(f"{path}: {name[:80]!r} is no cell")
    return int(match[1]), int(match[2]), int(match[3])


def decode_store(path: Path, out: Path, threads: int | None = None) -> int:
    """Makes a grid store of a file; returns the number of its Gaussians. Positions are rounded, so a few may come to
    lie on the other side of their cell's border.

    Raises:
        FormatError: the file is none, or damaged.
        RunFolderError: `out` is not empty, or cannot be written.
    """
    cells, count = CodedCells(path), 0
    try:
        settings = replace(INDOORS, spacing=cells.head.spacing, axes=cells.head.axes)
    except ConfigError as error:
        raise FormatError(f"{path}: {error}") from None
    with GridStore.create(out, settings) as store:
        store.begin_visit(path.name)
        waiting = list[CellWrite]()
        for key in sorted(cells.members):
            gaussians = cells.read(key, threads)
            data = gaussians_to_bytes(arrays_of_map(gaussians), None)
            waiting.append(CellWrite(key, {GAUSSIANS: data}, counts={GAUSSIANS: len(gaussians)}))
            count += len(gaussians)
            if len(waiting) == _CELLS_AT_ONCE:
                store.put_cells(waiting)
                waiting = []
        store.put_cells(waiting)
    return count
