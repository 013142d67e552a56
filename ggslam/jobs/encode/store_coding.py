# SPDX-License-Identifier: Apache-2.0
"""A grid store's Gaussians in one file, coded cell by cell: `ggslam encode STORE map.ggc`.

A zip archive whose members are stored as they are, so that a reader takes the cells that it needs:

    cells.json          see `runs.records.cells.CellsRecord`: grid, quality; of each cell Gaussians, bytes and SHA-256
    cells/3_0_-2.bin    a G-PCC stream of the Gaussians of cell (3, 0, -2); `ggslam decode` reads it, too
    objects.json.xz     the store's objects and what visits found of them, if it knows any
    visits/0.json.xz    what the store remembers of its first visit, if it does; and so on

Positions are coded in voxels that suit a cell's Gaussians, but no finer than those of coding all cells, but the few
outermost, at once.
"""

from __future__ import annotations

import hashlib
import time
import zipfile
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from ggslam import __version__
from ggslam.coding import CodecSettings, encode_cloud
from ggslam.coding.outliers import OutlierTuning, bulk_of
from ggslam.coding.splats import SplatCodingTuning, finest_voxel, means_of, rest_range, splat_attributes, splat_settings
from ggslam.errors import ConfigError, FormatError
from ggslam.jobs.encode.coded_cells import HEAD, OBJECTS, VISIT
from ggslam.jobs.encode.stream_output import check_stream_output
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.stores.over_cells import over_cells
from ggslam.jobs.submaps.cell_gaussians import (
    GAUSSIANS,
    gaussians_from_bytes,
    map_of_arrays,
)
from ggslam.jobs.tasks.engines import Engine
from ggslam.jobs.tasks.processors import own_threads
from ggslam.runs.records.cells import CELLS_FORMAT, CELLS_VERSION, CellMember, CellsRecord
from ggslam.runs.records.run_json import FileRecord
from ggslam.scene.packed_arrays import pack_bytes
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import GridStore
from ggslam.submaps.store_objects import objects_to_bytes, read_objects
from ggslam.submaps.visit_files import read_visit
from ggslam.system.atomic import atomic_write, make_folder, write_bytes
from ggslam.system.hidden_folder import hidden_beside
from ggslam.system.untrusted_files import read_untrusted


@dataclass(frozen=True)
class CodeTask:
    """A cell to code: its part with Gaussians, and how; `settings` name the voxel size, the least one or (`fixed`) that
    to take."""

    key: CellKey
    name: str
    data: bytes
    rate: str
    settings: CodecSettings
    fixed: bool = False


@dataclass
class CodedStore:
    """A written file: Gaussians in it, bytes of them in the store, bytes by cell, cells that could not be coded and
    why, whose fault that is (`exit_code` of errors: 2: the store's), and seconds."""

    path: Path
    gaussians: int = 0
    store_bytes: int = 0
    sizes: dict[CellKey, int] = field(default_factory=dict)
    failures: dict[CellKey, str] = field(default_factory=dict)
    exit_code: int = 2
    seconds: float = 0.0


def encode_cell(task: CodeTask) -> bytes:
    """The stream of a cell. Raises FormatError if its Gaussians are damaged."""
    gaussians = map_of_arrays(gaussians_from_bytes(task.data, task.name)[0])
    rest = rest_range([gaussians])
    attributes = splat_attributes(gaussians, with_ids=True, rest=rest)
    voxel = task.settings.voxel_size or 0.0
    if not task.fixed:
        voxel = max(voxel, finest_voxel([gaussians], len(gaussians), task.rate))
    settings = replace(task.settings, threads=own_threads(), voxel_size=voxel or None)
    settings = splat_settings(settings, task.rate, attributes, rest)
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
        ConfigError: it has no Gaussians, or no such rate; or `out` is there and no such file.
        GgslamError: it is no store, or the file cannot be written. (Damaged cells are left out and told.)
    """
    start, chosen = time.perf_counter(), settings or CodecSettings()
    check_stream_output(out, [path])
    make_folder(out.parent)
    with GridStore.open(path) as store, hidden_beside(out) as folder:
        make_folder(folder)
        counts = {key: count for key, count in store.counts(GAUSSIANS).items() if count}
        coding = _Coding(store, folder, CodedStore(out), counts)
        if not counts:
            raise ConfigError(f"{path}: has no Gaussians to code; stores made of runs have some")
        fixed = chosen.voxel_size is not None
        if not fixed:
            chosen = replace(chosen, voxel_size=_step(store, counts))
        task_of = partial(coding.task, rate=rate, settings=chosen, fixed=fixed)
        failures = over_cells(
            "encode", sorted(counts), task_of, encode_cell, coding.take, engine or Engine(),
            observer or SilentObserver(),
        )  # fmt: skip
        coding.outcome.failures = {key: failure.line for key, failure in failures.items()}
        coding.outcome.exit_code = min((2, *(failure.exit_code for failure in failures.values())))
        coding.join(rate)
    coding.outcome.seconds = time.perf_counter() - start
    return coding.outcome


@dataclass
class _Coding:
    """A store being coded, each cell into a file of a folder first."""

    store: GridStore
    folder: Path
    outcome: CodedStore
    counts: dict[CellKey, int]
    seen_by: dict[CellKey, str | None] = field(default_factory=dict)
    members: dict[CellKey, CellMember] = field(default_factory=dict)

    def task(self, key: CellKey, rate: str, settings: CodecSettings, fixed: bool) -> CodeTask:
        """Of a cell. Raises FormatError if it is damaged."""
        data = self.store.get(key, GAUSSIANS)
        self.outcome.store_bytes += len(data)
        what = f"{self.store.path}: cell {key}: no Gaussians written by ggslam"
        self.seen_by[key] = gaussians_from_bytes(data, what)[1]
        return CodeTask(key, what, data, rate, settings, fixed)

    def take(self, key: CellKey, found: bytes) -> None:
        """A cell was coded."""
        write_bytes(self.folder / _file_of(key), found)
        cell = self.store.cell(key)
        self.members[key] = CellMember(
            gaussians=self.counts[key], bytes=len(found), sha256=hashlib.sha256(found).hexdigest(),
            visit=cell.visit, seen_by=self.seen_by[key], recorded_at=cell.recorded_at,
        )  # fmt: skip

    def join(self, rate: str) -> None:
        """Writes the file."""
        if not self.members:
            error = FormatError(next(iter(self.outcome.failures.values())))
            error.exit_code = self.outcome.exit_code
            raise error
        keys, own, files = sorted(self.members), self.store.settings, self._files()
        head = CellsRecord(
            format=CELLS_FORMAT, version=CELLS_VERSION, ggslam=__version__, rate=rate, spacing=own.spacing,
            axes=own.axes, cells={f"cells/{_file_of(key)}": self.members[key] for key in keys},
            visits=self.store.visits(),
            files={n: FileRecord(bytes=len(b), sha256=hashlib.sha256(b).hexdigest()) for n, b in files.items()},
        )  # fmt: skip
        with atomic_write(self.outcome.path) as path, zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            archive.writestr(zipfile.ZipInfo(HEAD), head.model_dump_json(indent=1))
            for name, content in files.items():
                archive.writestr(zipfile.ZipInfo(name), content)
            for key in keys:
                archive.writestr(zipfile.ZipInfo(f"cells/{_file_of(key)}"), read_untrusted(self.folder / _file_of(key)))
        self.outcome.sizes = {key: self.members[key].bytes for key in keys}
        self.outcome.gaussians = sum(member.gaussians for member in self.members.values())


    def _files(self) -> dict[str, bytes]:
        """What the store knows of objects and remembers of visits, as members."""
        objects = read_objects(self.store)
        found = {} if objects is None else {OBJECTS: pack_bytes(objects_to_bytes(objects))}
        for number, visit in enumerate(self.store.visits()):
            record = read_visit(self.store, visit)
            if record is not None:
                found[VISIT.format(number)] = pack_bytes(record)
        return found


def _file_of(key: CellKey) -> str:
    return f"{key[0]}_{key[1]}_{key[2]}.bin"


def _step(store: GridStore, counts: dict[CellKey, int]) -> float:
    """Edge of the voxels: that of a grid of `position_bits` over the cells, but those of a few Gaussians far away."""
    keys = np.array(list(counts))
    numbers = np.maximum(1, np.array(list(counts.values())) // max(1, sum(counts.values()) // OutlierTuning.sample))
    extent = (np.ptp(bulk_of(np.repeat(keys, numbers, axis=0)), axis=0) + 1)[store.grid.spans].max()
    return float(extent * store.grid.spacing) / (1 << SplatCodingTuning.position_bits)
