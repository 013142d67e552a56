# SPDX-License-Identifier: Apache-2.0
"""The part of a stored map around the sensor: the union of the cells within R', put together when the sensor enters a
cell (SRT-PM), with the cells ahead along the motion loaded in the background."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ggslam.submaps.cell_cache import byte_count
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.cell_points import POINTS, CellArrays
from ggslam.submaps.cells_around import CellsAround
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import load_points
from ggslam.submaps.settings import SubmapSettings

Loader = Callable[[GridStore, CellKey], CellArrays]
"""Decodes a cell: arrays of one length, "points" [N, 3] among them."""

_NOTHING: CellArrays = {"points": np.empty((0, 3), np.float32)}


class PartialMap(CellsAround[CellArrays]):
    """Points and attributes of the cells around the sensor, as arrays that are never written to again.

    The union takes its memory twice while it is put together; `cells` are views of it.

    Args:
        store: where the cells are; it must stay open.
        settings: None: the store's.
        loader: decodes a cell.

    Raises:
        ConfigError: `settings` have another grid than the store.
    """

    def __init__(self, store: GridStore, settings: SubmapSettings | None = None, loader: Loader = load_points) -> None:
        super().__init__(store, loader, POINTS, byte_count, settings)
        self.arrays: CellArrays = _NOTHING
        """The union: "points" [N, 3] in metres, world, and the attributes that all its cells have."""
        self.slices: Mapping[CellKey, slice] = {}
        """The rows of each cell in `arrays`."""

    @property
    def points(self) -> np.ndarray:
        """Points of the union, [N, 3] in metres, world."""
        return self.arrays["points"]

    def _to_keep(self, cells: Mapping[CellKey, CellArrays]) -> Mapping[CellKey, CellArrays]:
        self.arrays, self.slices = _union(cells)
        return {key: {name: v[rows] for name, v in self.arrays.items()} for key, rows in self.slices.items()}


def _union(cells: Mapping[CellKey, CellArrays]) -> tuple[CellArrays, dict[CellKey, slice]]:
    """The arrays of all cells one after another, attributes that all have, and the rows of each."""
    if not cells:
        return _NOTHING, {}
    names = [name for name in next(iter(cells.values())) if all(name in cell for cell in cells.values())]
    arrays = {name: np.concatenate([cell[name] for cell in cells.values()]) for name in names}
    ends = np.cumsum([len(cell["points"]) for cell in cells.values()]).tolist()
    starts = [0, *ends[:-1]]
    return arrays, {key: slice(a, b) for key, a, b in zip(cells, starts, ends, strict=True)}
