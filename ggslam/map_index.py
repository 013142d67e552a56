# SPDX-License-Identifier: Apache-2.0
"""`map_cells.json`: where the cells of a map lie in map.ply, so that a view can be rendered without the whole map.

Runs whose memory was limited write their map cell by cell and this beside it. Other runs have none and are read whole.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.atomic import write_text
from ggslam.formats.gaussian_ply import gaussians_of_vertices
from ggslam.formats.ply_rows import PlyRows
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.submaps.frustums import Frustums
from ggslam.submaps.gaussian_cells import GaussianCells

MAP_INDEX = "map_cells.json"
_VERSION = 1


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
    def read(path: Path) -> MapIndex:
        """Reads the file.

        Raises:
            FormatError: it is missing, damaged or of another version.
        """
        try:
            values = json.loads(path.read_text())
            if values["version"] != _VERSION:
                raise ValueError(f"version {values['version']}, this program reads version {_VERSION}")
            columns = [np.array([row[name] for row in values["cells"]]) for name in ("start", "count", "low", "high")]
            starts, counts, low, high = columns
            good = starts.ndim == 1 and low.shape == high.shape == (len(starts), 3) and np.isfinite(low + high).all()
            if not good or (counts < 1).any() or (starts != np.cumsum(counts) - counts).any():
                raise ValueError("the cells do not follow each other")
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise FormatError(f"{path}: not the index of a map: {error}") from None
        return MapIndex(starts.astype(np.int64), counts.astype(np.int64), low.astype(float), high.astype(float))


class MapInParts:
    """A map on disk, of which what a view needs is read.

    Args:
        ply: the file of the map.
        index: where its cells are.

    Raises:
        FormatError: they do not fit together.
    """

    def __init__(self, ply: Path, index: MapIndex) -> None:
        self.path, self.index = ply, index
        self._rows = PlyRows(ply, "vertex")
        if self._rows.count != int(index.counts.sum()):
            raise FormatError(f"{ply}: has {self._rows.count} Gaussians, {MAP_INDEX} beside it speaks of others")
        self._shown: tuple[int, ...] | None = None
        self._map: GaussianMap | None = None

    def __len__(self) -> int:
        return self._rows.count

    def cells(self) -> list[int]:
        """Numbers of the cells."""
        return list(range(len(self.index.counts)))

    def read(self, cells: list[int]) -> GaussianMap:
        """The Gaussians of some cells, rising, without optimizer state."""
        parts = [self._rows.read(int(self.index.starts[i]), int(self.index.counts[i])) for i in cells]
        vertex = np.concatenate(parts) if parts else self._rows.read(0, 0)
        return gaussians_of_vertices(self.path, vertex, with_moments=False)

    def in_view(self, camera: Camera, T_camera_world: np.ndarray, reach: float = 1e6) -> GaussianMap:
        """All Gaussians that a camera may see, read anew only when other cells come into view."""
        frustum = Frustums.of(camera, T_camera_world, [reach])
        cells = tuple(np.flatnonzero(frustum.touch(self.index.low, self.index.high)[0]).tolist())
        if self._map is None or cells != self._shown:
            self._map = None  # two of them need not fit into memory
            self._map, self._shown = self.read(list(cells)), cells
        return self._map
