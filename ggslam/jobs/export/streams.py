# SPDX-License-Identifier: Apache-2.0
"""A run's map, or that of a grid store, as streamed SOG: in pieces and levels of detail."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from ggslam.errors import RunFolderError
from ggslam.formats.point_sampling import MapPart
from ggslam.formats.streamed_sog import INDEX, StreamedSize, write_streamed_sog
from ggslam.jobs.export.chosen import ChosenGaussians, Prepare
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS, gaussians_of_cell
from ggslam.runs.folder import RunFolder
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.submaps.grid import GridStore
from ggslam.system.atomic import make_empty_folder


def stream_run(
    folder: RunFolder, out: Path, objects: str | None = None, min_opacity: float = 0.0, plain: bool = False,
    observer: Observer | None = None, prepare: Prepare | None = None,
) -> str:  # fmt: skip
    """Writes a run's map as streamed SOG, cell by cell where it was written so; returns a line that says so.

    Args:
        folder: of the run.
        out: folder to write, new or empty, or `lod-meta.json` in it.
        objects: only these, names or ids, "mug,7", or "all"; None: the whole map.
        min_opacity: leave out fainter Gaussians.
        plain: leave out object ids and names, which are written of runs with objects.
        observer: receives progress updates.
        prepare: changes the Gaussians first.

    Raises:
        ConfigError: an object is not there.
        FormatError: what the format cannot hold.
        RunFolderError: nothing to write, the folder is not empty, or a file cannot be written.
    """
    table = folder.object_table() if objects is not None or folder.has_objects() else None
    ids = None if table is None or objects is None else table.select(objects)
    stored = folder.map_in_parts()
    chosen = ChosenGaussians.of(folder, stored.rows, min_opacity, ids, prepare)
    names = None if table is None or plain else {i: table.record(i).name or "" for i in ids or table.ids()}
    parts = [MapPart(part.low, part.high, partial(_of_part, chosen, part)) for part in stored.parts()]
    whole = [MapPart(stored.index.low[0], stored.index.high[0], chosen.whole)]
    return _write(out, parts if stored.in_cells else whole, chosen.count, names, observer)


def stream_store(path: Path, out: Path, min_opacity: float = 0.0, observer: Observer | None = None) -> str:
    """Writes the Gaussians of a grid store as streamed SOG, cell by cell; arguments and errors as of `stream_run`."""
    with GridStore.open(path) as store:
        counts = store.counts(GAUSSIANS)
        keys, count = list(counts), sum(counts.values())
        if not count:
            raise RunFolderError(f"{path}: no cell of the store has Gaussians; nothing to export")

        def read(number: int) -> GaussianMap:
            return _opaque(gaussians_of_cell(store, keys[number]), min_opacity)

        parts = [MapPart(store.centre_of(key), store.centre_of(key), partial(read, i)) for i, key in enumerate(keys)]
        return _write(out, parts, count, None, observer)


def _of_part(chosen: ChosenGaussians, part: MapPart) -> GaussianMap:
    gaussians = _opaque(part.load(), chosen.min_opacity)
    if chosen.ids is not None:
        gaussians.keep(torch.isin(gaussians.object_id, torch.tensor(chosen.ids)))
    if chosen.prepare is not None:
        chosen.prepare(gaussians)
    return gaussians


def _opaque(gaussians: GaussianMap, min_opacity: float) -> GaussianMap:
    gaussians.keep(gaussians.opacities >= min_opacity)
    return gaussians


def _write(
    out: Path, parts: Sequence[MapPart], count: int, names: dict[int, str] | None, observer: Observer | None
) -> str:
    told, folder = observer or SilentObserver(), out.parent if out.name == INDEX else out
    make_empty_folder(folder)
    told.begin("levels of detail", len(parts))
    size: StreamedSize = write_streamed_sog(folder, parts, count, names, lambda done: told.advance(done, len(parts)))
    levels = " + ".join(map(str, size.counts))
    files = f"{size.chunks} SOG{'s' * (size.chunks != 1)}"
    return f"wrote {folder / INDEX}: {levels} Gaussians in {files}, {size.bytes / 1e6:.1f} MB"
