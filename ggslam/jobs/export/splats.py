# SPDX-License-Identifier: Apache-2.0
"""The Gaussians of a run, or of a grid store, as formats of Gaussians take them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

from ggslam.errors import RunFolderError
from ggslam.formats.point_sampling import MapPart
from ggslam.formats.writer import Splats, Takes, Writer
from ggslam.jobs.export.selection import ChosenGaussians, Prepare
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS, gaussians_of_cell
from ggslam.objects.table import ObjectTable
from ggslam.runs.folder import RunFolder
from ggslam.scene.gaussian_map import GaussianMap, rgb_to_sh
from ggslam.submaps.grid import GridStore


@dataclass(frozen=True)
class SplatRequest:
    """A request for Gaussians.

    Attributes:
        objects: of these only, names or ids, "mug,7", or "all"; None: of the whole map.
        min_opacity: leave out fainter ones.
        plain: leave out ids, names and identities of objects, which are written of runs with objects.
        prepare: changes the Gaussians first.
    """

    objects: str | None = None
    min_opacity: float = 0.0
    plain: bool = False
    prepare: Prepare | None = None


def splats_of(folder: RunFolder, writer: Writer, request: SplatRequest, observer: Observer | None = None) -> Splats:
    """What a format of Gaussians is given.

    Raises:
        ConfigError: an object is not there.
        RunFolderError: nothing to write, or colours of objects are wanted of a run that has none.
    """
    colored = writer.takes is Takes.OBJECT_COLORS
    known = colored or request.objects is not None or (writer.by_object and folder.has_objects())
    table = folder.object_table() if known else None
    ids = None if table is None or request.objects is None else table.select(request.objects)
    prepare, note = request.prepare, ""
    if colored and table is not None:
        prepare = in_turn(prepare, partial(_color_by_object, palette=torch.from_numpy(table.palette())))
        objects = len(table if ids is None else ids)
        note = f" in the colours of {objects} object{'s' * (objects != 1)}"
    stored = folder.map_in_parts()
    chosen = ChosenGaussians.of(folder, stored.rows, request.min_opacity, ids, prepare)
    names = None if table is None or request.plain else _names(table, ids)
    whole = [MapPart(stored.index.low[0], stored.index.high[0], chosen.whole)]
    return Splats(
        chosen.count, stored.rows.like, chosen.parts, chosen.whole,
        lambda: [MapPart(part.low, part.high, partial(_of_part, chosen, part)) for part in stored.parts()]
        if stored.in_cells else whole,
        names, None if names is None else folder.classifier, note, _progress(observer),
    )  # fmt: skip


@contextmanager
def splats_of_store(path: Path, min_opacity: float = 0.0, observer: Observer | None = None) -> Iterator[Splats]:
    """The Gaussians of a grid store, which are read while they are written; raises RunFolderError if it has none."""
    with GridStore.open(path) as store:
        keys = [key for key in store.cells() if GAUSSIANS in store.cell(key).parts]
        count = sum(store.cell(key).parts[GAUSSIANS].count for key in keys)
        if not count:
            raise RunFolderError(f"{path}: no cell of the store has Gaussians; nothing to export")

        def read(number: int) -> GaussianMap:
            return _opaque(gaussians_of_cell(store, keys[number]), min_opacity)

        def cells() -> list[MapPart]:
            centres = map(store.centre_of, keys)
            return [MapPart(centre, centre, partial(read, number)) for number, centre in enumerate(centres)]

        def parts() -> Iterator[GaussianMap]:
            return map(read, range(len(keys)))

        def whole() -> GaussianMap:
            first, *rest = parts()
            for part in rest:
                first.append(part.take(torch.arange(len(part))))
            return first

        yield Splats(count, read(0), parts, whole, cells, done=_progress(observer))


def in_turn(first: Prepare | None, then: Prepare | None) -> Prepare | None:
    """One after the other, where there are both."""
    if first is None or then is None:
        return first or then

    def both(gaussians: GaussianMap) -> None:
        first(gaussians)
        then(gaussians)

    return both


def _names(table: ObjectTable, ids: Sequence[int] | None) -> dict[int, str]:
    return {i: table.record(i).name or "" for i in ids or table.ids()}


def _color_by_object(gaussians: GaussianMap, palette: torch.Tensor) -> None:
    """Gives each Gaussian the colour of its object, from all sides; unlabelled ones become grey."""
    gaussians.sh[:] = 0
    gaussians.sh[:, 0] = rgb_to_sh(palette[gaussians.object_id.long()].float() / 255)


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


def _progress(observer: Observer | None) -> Callable[[int, int], None]:
    told = observer or SilentObserver()

    def tell(count: int, of: int) -> None:
        if not count:
            told.begin("levels of detail", of)
        else:
            told.advance(count, of)

    return tell
