# SPDX-License-Identifier: Apache-2.0
"""Volumes of a grid store, cell by cell: what `ggslam volumes STORE` does.

    OUT/                       a grid store of the same cells
        cells/.../tsdf.npz     the signed distances of a cell's blocks
        cells/.../mesh.npz     its triangles
        cells/.../esdf.npz     distances to the nearest surface in its voxels
        mesh.ply               the surface of all cells, whose seams are closed

First every cell is fused, then meshed (and its distances found) with the blocks of the cells around it. Cells that are
done stay if this is cut off; the same call goes on.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from ggslam import __version__
from ggslam.errors import ConfigError, RunFolderError
from ggslam.formats.mesh_files import write_mesh
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.stores.over_cells import Task, error_of, over_cells, raise_own_fault
from ggslam.jobs.submaps.visit_records import recording_text, records_of_store
from ggslam.jobs.tasks.engines import Engine
from ggslam.jobs.tasks.outcomes import Failure
from ggslam.jobs.volumes.cell_volumes import (
    BlocksTask,
    CellBlocks,
    CellPart,
    FuseTask,
    LookTask,
    field_cell,
    fuse_cell,
    look_at_frames,
    mesh_cell,
    mesh_from_bytes,
)
from ggslam.jobs.volumes.outputs import VolumeOutputTuning
from ggslam.runs.records.visit import VisitRecord
from ggslam.scene.arrays import arrays_of, arrays_to_bytes
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.grid import INDEX, GridStore
from ggslam.system.tuning import Tuning
from ggslam.volumes.esdf import FieldSettings
from ggslam.volumes.mesh import Mesh, join_meshes, without_small_pieces
from ggslam.volumes.tsdf import MOST_VOXELS
from ggslam.volumes.tsdf_file import blocks_within, join_blocks
from ggslam.volumes.volume_settings import VolumeSettings

TSDF, MESH, ESDF = "tsdf.npz", "mesh.npz", "esdf.npz"
WHOLE_MESH = "mesh.ply"


class StoreVolumeTuning(Tuning):
    """Memory and limits of a store's volumes."""

    cells_in_memory = 32
    """TSDFs of cells that are kept in memory: all neighbours of a cell ask for it."""
    frames_at_once = 16
    """Frames that a worker looks through in one task."""
    max_cells = 500_000
    """Most cells in the box around cells and cameras, all of which are checked; 1 KB each."""
    max_checks = 1_000_000_000
    """Most checks of a cell in a frame; a byte each."""


_FUSED = "fused"
"""A visit of the results, begun when all cells are fused."""


@dataclass
class StoreVolumes:
    """Result of making the volumes of a store.

    Attributes:
        out: folder of the results, a grid store with a mesh of the whole.
        cells: with blocks.
        blocks: of the TSDF in all cells.
        triangles: of the whole mesh.
        failures: cells that could not be made, and why.
        seconds: by stage.
    """

    out: Path
    cells: int = 0
    blocks: int = 0
    triangles: int = 0
    failures: dict[CellKey, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


def make_store_volumes(
    path: str | Path, out: str | Path | None = None, *, settings: VolumeSettings | None = None, esdf: bool = False,
    engine: Engine | None = None, observer: Observer | None = None,
) -> StoreVolumes:  # fmt: skip
    """Fuses the frames of the runs that filled a store, cell by cell.

    Args:
        path: of the store.
        out: folder of the results; None: `volumes` in the store.
        settings: of TSDF and distance field.
        esdf: whether distances are wanted.
        engine: where; None: on this machine.
        observer: receives progress updates.

    Raises:
        ConfigError: nothing is known of the recordings that the store is from, or its cells lie too far apart.
        GgslamError: a recording is not there any more, or the results cannot be written.
    """
    path, settings = Path(path), settings or VolumeSettings()
    out = path / "volumes" if out is None else Path(out)
    with GridStore.open(path) as store:
        records = records_of_store(store)
        work = _Work(store, records, settings)
        with _open_results(out, store, work.name(esdf)) as results:
            return _Volumes(work, results, engine or Engine(), observer or SilentObserver()).run(esdf)


def _open_results(out: Path, store: GridStore, work: str) -> GridStore:
    """The results of the same work that was cut off, or new ones in the place of others."""
    out = out.resolve() if out.is_symlink() else out  # the user's choice; what is there may be replaced as a whole
    if (out / INDEX).is_file():
        results = GridStore.open(out, write=True)
        if results.visits()[:1] in ([], [work]):
            results.begin_visit(work)
            return results
        results.close()
        if not _is_ours(out):
            raise RunFolderError(f"{out}: is another grid store; choose another folder with `out`")
        shutil.rmtree(out)
    results = GridStore.create(out, store.settings)
    results.begin_visit(work)
    return results


def _is_ours(out: Path) -> bool:
    """Whether a store holds volumes and nothing else."""
    with GridStore.open(out) as store:
        return all(set(store.cell(key).parts) <= {TSDF, MESH, ESDF} for key in store.cells())


class _Work:
    """Which cells are made of which frames. Raises ConfigError if the cells lie too far from one another or the
    origin."""

    def __init__(self, store: GridStore, records: list[VisitRecord], settings: VolumeSettings) -> None:
        self.store, self.settings = store, settings
        self.texts = tuple(map(recording_text, records))
        self.poses = [(visit, frame, T) for visit, r in enumerate(records) for frame, T in sorted(r.poses.items())]
        self._low, self._high = self._extent()
        self.seen = np.zeros((len(self.poses), 0), bool)
        """Which of the cells `keys` each frame may tell about, once that was looked up."""

    def name(self, esdf: bool) -> str:
        """Made of all that the result depends on."""
        poses = [[visit, frame, T.tolist()] for visit, frame, T in self.poses]
        wanted = [asdict(self.settings.tsdf), asdict(self.settings.esdf) if esdf else None, self.settings.min_weight]
        return hashlib.sha256(json.dumps([__version__, wanted, self.texts, poses]).encode()).hexdigest()

    def blocks(self, key: CellKey) -> CellBlocks:
        """Of a cell."""
        return CellBlocks.of(self.store.grid, key, self.settings.tsdf.voxel)

    def keys(self) -> list[CellKey]:
        """Cells that may have blocks, sorted: those around the store's cells and the cameras."""
        low, high = self._low, self._high
        return [(x, y, z) for x in range(low[0], high[0] + 1) for y in range(low[1], high[1] + 1)
                for z in range(low[2], high[2] + 1)]  # fmt: skip

    def _extent(self) -> tuple[list[int], list[int]]:
        """Least and greatest coordinates of cells that may have blocks. An index from elsewhere may hold cells
        anywhere: all in between can be looked at, and their blocks have coordinates."""
        grid, voxel = self.store.grid, self.settings.tsdf.voxel
        there = [*self.store.cells(), *(self.store.key_of(T[:3, 3]) for _, _, T in self.poses)]
        if not there:
            raise ConfigError(f"{self.store.path}: has no cells, and no frame of its runs has a pose")
        low, high = np.min(there, axis=0) - grid.spans, np.max(there, axis=0) + grid.spans
        where = f"{self.store.path}: its cells reach from {low.tolist()} to {high.tolist()}"
        most = min(StoreVolumeTuning.max_cells, StoreVolumeTuning.max_checks // max(1, len(self.poses)))
        if math.prod((high - low + 1).tolist()) > most:
            raise ConfigError(f"{where}; volumes are made of at most {most:,} cells together: is the index damaged?")
        if np.abs([low, high]).max() * grid.spacing > MOST_VOXELS * voxel:
            raise ConfigError(f"{where}; too far away for voxels of {voxel:g} m: is the index damaged?")
        return low.tolist(), high.tolist()

    def looks(self, keys: list[CellKey]) -> list[LookTask]:
        """What finding out which frames tell about which cells needs."""
        blocks = [self.blocks(key) for key in keys]
        low = np.array([b.low for b in blocks], float) * blocks[0].edge
        high = (np.array([b.high for b in blocks], float) + 1) * blocks[0].edge
        return [
            LookTask(
                first,
                self.texts,
                tuple(self.poses[first : first + StoreVolumeTuning.frames_at_once]),
                low,
                high,
                self.settings.tsdf,
            )
            for first in range(0, len(self.poses), StoreVolumeTuning.frames_at_once)
        ]

    def views(self, keys: list[CellKey]) -> dict[CellKey, tuple[tuple[int, int, np.ndarray], ...]]:
        """The frames that tell about each of the cells, as `FuseTask` has them; cells that none tells about are left
        out."""
        rows = {key: np.flatnonzero(self.seen[:, column]) for column, key in enumerate(keys)}
        return {key: tuple(self.poses[row] for row in own) for key, own in rows.items() if len(own)}


@dataclass
class _Volumes:
    """The volumes of a store while they are made."""

    work: _Work
    results: GridStore
    engine: Engine
    observer: Observer

    def run(self, esdf: bool) -> StoreVolumes:
        """All stages."""
        outcome = StoreVolumes(self.results.path)
        self._look_and_fuse(outcome)
        counts = self.results.counts(TSDF)
        filled = sorted(key for key, count in counts.items() if count)
        if not filled:
            raise ConfigError(f"{self.work.store.path}: no depth of its runs' frames could be fused")
        outcome.cells, outcome.blocks, there = len(filled), sum(counts.values()), set(filled)
        self._stage("mesh", mesh_cell, filled, self._blocks_tasks(there, 1, None), MESH, outcome)
        if esdf:
            field_settings = self.work.settings.esdf
            reach = math.ceil(field_settings.max_distance / self.work.blocks(filled[0]).edge) + 1
            task_of = self._blocks_tasks(there, reach, field_settings)
            self._stage("distances", field_cell, filled, task_of, ESDF, outcome)
        start = time.perf_counter()
        mesh = self.whole_mesh(filled)
        write_mesh(self.results.path / WHOLE_MESH, mesh.vertices, mesh.triangles, mesh.normals, mesh.colors)
        outcome.triangles, outcome.seconds["join"] = len(mesh.triangles), time.perf_counter() - start
        outcome.failures = dict(sorted(outcome.failures.items()))
        return outcome

    def _look_and_fuse(self, outcome: StoreVolumes) -> None:
        """Finds the frames of each cell, and fuses them."""
        if _FUSED in self.results.visits():
            return
        start, keys, work = time.perf_counter(), self.work.keys(), self.work
        work.seen = np.zeros((len(work.poses), len(keys)), bool)
        looks = work.looks(keys)
        self.observer.begin("look", len(looks))

        def take(task: LookTask, found: np.ndarray | Failure) -> None:
            if isinstance(found, Failure):
                raise error_of(found, found.line)
            work.seen[task.key : task.key + len(found)] = found
            self.observer.advance(task.key // StoreVolumeTuning.frames_at_once + 1, len(looks))

        self.engine.do(look_at_frames, looks, take)
        outcome.seconds["look"] = time.perf_counter() - start
        views = work.views(keys)

        def task_of(key: CellKey) -> FuseTask:
            return FuseTask(key, work.blocks(key), work.texts, views[key], work.settings.tsdf)

        self._stage("fuse", fuse_cell, list(views), task_of, TSDF, outcome)
        self.results.begin_visit(_FUSED)

    def whole_mesh(self, keys: list[CellKey]) -> Mesh:
        """The meshes of all cells as one: vertices on their seams are the same."""
        there = [key for key in keys if self._has(key, MESH)]
        parts = [mesh_from_bytes(self.results.get(key, MESH), f"{self.results.path}: cell {key}") for key in there]
        return without_small_pieces(join_meshes(parts), VolumeOutputTuning.min_piece_triangles)

    def _has(self, key: CellKey, part: str) -> bool:
        return key in self.results and part in self.results.cell(key).parts

    def _stage(
        self, name: str, work: Callable[[Task], CellPart], keys: list[CellKey], task_of: Callable[[CellKey], Task],
        part: str, outcome: StoreVolumes,
    ) -> None:  # fmt: skip
        """Makes a part of those of the cells that do not have it."""

        def take(key: CellKey, found: CellPart) -> None:
            self.results.put(key, {part: found.data}, counts={part: found.count})

        start, todo = time.perf_counter(), [key for key in keys if not self._has(key, part)]
        failures = over_cells(name, todo, task_of, work, take, self.engine, self.observer)
        outcome.seconds[name] = time.perf_counter() - start
        outcome.failures |= {key: failure.line for key, failure in failures.items()}
        raise_own_fault(failures, f"{self.results.path}: {{}} could not be made")

    def _tsdf(self, key: CellKey) -> dict[str, np.ndarray]:
        """The arrays of a cell's TSDF."""
        held, what = io.BytesIO(self.results.get(key, TSDF)), f"{self.results.path}: cell {key}: no TSDF"
        return arrays_of(held, what, lambda found: {name: found[name] for name in found.files})

    def _blocks_tasks(
        self, filled: set[CellKey], around: int, settings: FieldSettings | None
    ) -> Callable[[CellKey], BlocksTask]:
        """Makes tasks of cells with their blocks and so many around them; `filled`: cells with blocks."""
        read, edge = lru_cache(StoreVolumeTuning.cells_in_memory)(self._tsdf), self.work.blocks(next(iter(filled))).edge
        steps = math.ceil(around * edge / self.work.store.grid.spacing + 0.5)

        def task_of(key: CellKey) -> BlocksTask:
            blocks, near = self.work.blocks(key), self.results.around(key, TSDF, steps)
            parts = [blocks_within(read(other), *blocks.around(around)) for other in near if other in filled]
            held = arrays_to_bytes(**join_blocks(parts))
            return BlocksTask(key, blocks, held, settings, self.work.settings.min_weight)

        return task_of
