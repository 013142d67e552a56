# SPDX-License-Identifier: Apache-2.0
"""`map_cells.json`: where the cells of a map lie in map.ply, so that a view can be rendered without the whole map.

Runs whose memory was limited write their map cell by cell and this beside it. Other runs have none and are read whole.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch

from ggslam.errors import FormatError
from ggslam.formats.gaussian_rows import GaussianRows
from ggslam.formats.point_sampling import MapPart
from ggslam.geometry.frustums import Frustums
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.submaps.gaussian_cells import GaussianCells
from ggslam.system.atomic import write_text
from ggslam.system.process_memory import release_early
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import read_untrusted_text

MAP_INDEX = "map_cells.json"
_VERSION: Final = 1
"""Version of the index."""


class MapIndexTuning(Tuning):
    """How a map in cells is read."""

    anywhere_m = 1e12
    """Distance that stands for "everywhere", in metres."""
    cache_bytes = 64_000_000
    """Bytes of cells that are kept in memory because they may be in view again."""


def write_map_index(path: Path, cells: GaussianCells) -> None:
    """Writes where each cell's rows are in a map.ply that holds the cells in their order."""
    rows, start = [], 0
    for key in cells.sorted_keys():
        low, high = cells.box(key)
        count = cells.count_in([key])
        rows.append({"cell": list(key), "start": start, "count": count, "low": low.tolist(), "high": high.tolist()})
        start += count
    values = {"version": _VERSION, "spacing_m": cells.store.grid.spacing, "gaussians": start, "cells": rows}
    write_text(path, json.dumps(values) + "\n")


@dataclass(frozen=True)
class MapIndex:
    """Cells of a map on disk.

    Attributes:
        starts, counts: int64 [n], first row and number of rows of each in map.ply.
        low, high: float64 [n, 3], corners of the box that its Gaussians reach to, metres.
    """

    starts: np.ndarray
    counts: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @staticmethod
    def of_whole(count: int) -> MapIndex:
        """That of a map that is one cell, whose Gaussians may be anywhere."""
        far = np.full((1, 3), MapIndexTuning.anywhere_m)
        return MapIndex(np.zeros(1, np.int64), np.array([count]), -far, far)

    @staticmethod
    def read(path: Path) -> MapIndex:
        """Reads the file.

        Raises:
            FormatError: it is missing, damaged or of another version.
        """
        try:
            values = json.loads(read_untrusted_text(path))
            if values["version"] != _VERSION:
                raise ValueError(f"version {values['version']}, this program reads version {_VERSION}")
            columns = [np.array([row[name] for row in values["cells"]]) for name in ("start", "count", "low", "high")]
            starts, counts, low, high = columns
            good = starts.ndim == 1 and low.shape == high.shape == (len(starts), 3) and np.isfinite(low + high).all()
            if not good or (counts < 1).any() or (starts != np.cumsum(counts) - counts).any():
                raise ValueError("the cells do not follow each other")
        except (ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
            raise FormatError(f"{path}: not the index of a map: {error}") from None
        return MapIndex(starts.astype(np.int64), counts.astype(np.int64), low.astype(float), high.astype(float))


class MapInParts:
    """A map on disk of which only what a view needs is read.

    Args:
        ply: the file of the map, or its rows.
        index: where its cells are; None: the whole map is one cell, which every view needs.
        cache_bytes: of cells that were read, in addition to those of the last view, as many are kept.

    Raises:
        FormatError: they do not fit together.
    """

    def __init__(
        self, ply: Path | GaussianRows, index: MapIndex | None, cache_bytes: int = MapIndexTuning.cache_bytes
    ) -> None:
        self.rows = ply if isinstance(ply, GaussianRows) else GaussianRows(ply)
        """For going through all of the map."""
        self.in_cells = index is not None
        if index is not None:
            release_early()  # of a map that may not fit into memory
        """Whether there is an index."""
        self.index = MapIndex.of_whole(len(self.rows)) if index is None else index
        if len(self.rows) != int(self.index.counts.sum()):
            found = f"has {len(self.rows)} Gaussians, {MAP_INDEX} beside it is of another map"
            raise FormatError(f"{self.rows.path}: {found}")
        self._cached: OrderedDict[int, GaussianMap] = OrderedDict()
        self._room = cache_bytes // max(1, self.rows.like.bytes_per_gaussian)
        self._shown: tuple[int, ...] | None = None
        self._map: GaussianMap | None = None

    @staticmethod
    def of_folder(folder: Path) -> MapInParts:
        """That of a run: to be read in blocks of rows, or as far as a view needs it if it was written cell by cell.

        Raises:
            FormatError: map or index are damaged or do not belong together.
        """
        index = folder / MAP_INDEX
        return MapInParts(folder / "map.ply", MapIndex.read(index) if index.is_file() else None)

    def __len__(self) -> int:
        return len(self.rows)

    def cells(self) -> list[int]:
        """Numbers of the cells."""
        return list(range(len(self.index.counts)))

    def read(self, cells: Sequence[int]) -> GaussianMap:
        """The Gaussians of some cells, rising, without optimizer state."""
        if len(cells) == 1:
            return self._cell(cells[0])
        like = self.rows.like
        out = GaussianMap(like.sh_degree, like.features.shape[1], with_moments=False)
        out.growth = 0
        out.reserve(int(self.index.counts[list(cells)].sum()))
        for cell in cells:
            part = self._cached.pop(cell, None)
            part = self._cell(cell) if part is None else part
            out.append(part.take(torch.arange(len(part))))
            self._cached[cell] = part
            self._forget_oldest()
        return out

    def in_view(self, camera: Camera, T_camera_world: np.ndarray, reach: float = 1e6) -> GaussianMap:
        """All Gaussians that a camera may see; those of the last view themselves if they lie in the same cells."""
        frustum = Frustums.of(camera, T_camera_world, [reach])
        cells = tuple(np.flatnonzero(frustum.touch(self.index.low, self.index.high)[0]).tolist())
        if self._map is None or cells != self._shown:
            self._map = None  # two of them need not fit into memory
            self._map, self._shown = self.read(cells), cells
        return self._map

    def shown_rows(self) -> np.ndarray:
        """Where in the file the Gaussians of the last view are, int64 [N]."""
        starts, shown = self.index.starts, self._shown or ()
        rows = [np.arange(starts[i], starts[i] + self.index.counts[i]) for i in shown]
        return np.concatenate(rows) if rows else np.empty(0, np.int64)

    def parts(self) -> list[MapPart]:
        """Its cells, to be read one at a time."""
        index = self.index
        return [MapPart(index.low[i], index.high[i], partial(self._cell, i)) for i in self.cells()]

    def _cell(self, cell: int) -> GaussianMap:
        return self.rows.read(int(self.index.starts[cell]), int(self.index.counts[cell]))

    def _forget_oldest(self) -> None:
        while self._cached and sum(map(len, self._cached.values())) > self._room:
            self._cached.popitem(last=False)
