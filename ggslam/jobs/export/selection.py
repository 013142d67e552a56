# SPDX-License-Identifier: Apache-2.0
"""The Gaussians of a run that are to be exported: opaque enough, and of some objects."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path

import torch

from ggslam.errors import RunFolderError
from ggslam.formats.gaussian_ply import write_gaussian_parts
from ggslam.formats.gaussian_rows import GaussianRows
from ggslam.runs.folder import RunFolder
from ggslam.scene.gaussian_map import GaussianMap

Prepare = Callable[[GaussianMap], None]
"""Changes Gaussians in place before they are exported."""


@dataclasses.dataclass(frozen=True)
class ChosenGaussians:
    """Gaussians of a map on disk that are to be exported.

    Attributes:
        rows: the map.
        min_opacity: fainter ones are left out.
        ids: of the objects whose Gaussians are wanted; None: all.
        found: of each block of rows, how many are opaque enough, by object id.
        prepare: changes Gaussians that were read; None: they are exported as they are.
    """

    rows: GaussianRows
    min_opacity: float
    ids: Sequence[int] | None
    found: Sequence[Counter[int]]
    prepare: Prepare | None = None

    @staticmethod
    def of(
        folder: RunFolder, rows: GaussianRows, min_opacity: float, ids: Sequence[int] | None = None,
        prepare: Prepare | None = None,
    ) -> ChosenGaussians:  # fmt: skip
        """Finds out how many there are; raises RunFolderError if there is none."""
        found = [Counter(b.object_id[b.opacities >= min_opacity].tolist()) for b in rows.blocks()]
        chosen = ChosenGaussians(rows, min_opacity, ids, found, prepare)
        if not chosen.count:
            raise RunFolderError(f"{folder.path}: no Gaussian is at least {min_opacity} opaque; nothing to export")
        return chosen

    def objects(self, ids: Sequence[int]) -> ChosenGaussians:
        """Those of some objects only."""
        return dataclasses.replace(self, ids=ids)

    @property
    def count(self) -> int:
        """How many there are."""
        return sum(map(self._count, self.found))

    def _count(self, found: Counter[int]) -> int:
        return found.total() if self.ids is None else sum(found[i] for i in self.ids)

    def write(
        self, path: Path, extra: Collection[str], change: Callable[[GaussianMap], None] = lambda part: None
    ) -> int:
        """Writes a 3DGS PLY of them, changed; returns how many there are."""
        write_gaussian_parts(path, self.count, self.parts(change), self.rows.like, extra)
        return self.count

    def parts(self, change: Callable[[GaussianMap], None] = lambda part: None) -> Iterator[GaussianMap]:
        """They themselves, block by block, changed."""
        for number, found in enumerate(self.found):
            if not self._count(found):
                continue
            part = self.rows.block(number)
            wanted = part.opacities >= self.min_opacity
            part.keep(wanted if self.ids is None else wanted & torch.isin(part.object_id, torch.tensor(self.ids)))
            if self.prepare is not None:
                self.prepare(part)
            change(part)
            yield part

    def whole(self) -> GaussianMap:
        """They themselves, in memory together, without optimizer state."""
        like = self.rows.like
        out = GaussianMap(like.sh_degree, like.features.shape[1], with_moments=False)
        out.growth = 0.0
        out.reserve(self.count)
        for part in self.parts():
            out.append(part.take(torch.arange(len(part))))
        return out
