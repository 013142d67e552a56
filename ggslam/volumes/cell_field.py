# SPDX-License-Identifier: Apache-2.0
"""The distance field of a TSDF whose cells are all on disk, made around a few cells at a time.

A distance depends on the surfaces within the field's reach, and a surface point on the voxels around its own. With all
cells that have some of these beside them, distances of a few cells are those of the whole map, bit for bit: as a field
has them that is made of it at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ggslam.system.tuning import Tuning
from ggslam.volumes.cell_boxes import boxes_of, in_memory
from ggslam.volumes.cell_grid import CellGrid, GridWindow, SlicePlane
from ggslam.volumes.cell_pager import CellPager
from ggslam.volumes.esdf import DistanceField, FieldSettings, FieldValues
from ggslam.volumes.held_distances import HeldDistanceTuning
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.volume_cells import CellKey, VolumeCells, as_keys, with_neighbours


class CellFieldTuning(Tuning):
    """How much is in memory at a time."""

    side = 4
    """Cells along an edge of the box whose distances are computed at a time; what they need around it is in memory,
    too."""


@dataclass(frozen=True)
class FieldPart:
    """A few cells, and what their distances need around them.

    Attributes:
        cells: the grid.
        own: these cells.
        tsdf: of them and those around.
        settings: how far distances of `own` are those of the whole map.
    """

    cells: VolumeCells
    own: set[CellKey]
    tsdf: TsdfMap
    settings: FieldSettings

    @cached_property
    def field(self) -> DistanceField:
        """Up to date. Beside `own` it may lack surfaces."""
        field = DistanceField(self.tsdf, self.settings)
        field.update()
        return field

    def owns(self, points: np.ndarray) -> np.ndarray:
        """Whether points [N, 3] from the TSDF's origin, metres, lie in its own cells, bool [N]."""
        own = np.array(sorted(self.own))
        low, shape = own.min(0), np.ptp(own, axis=0) + 1
        present = np.zeros(shape, bool)
        present[tuple((own - low).T)] = True
        at = np.floor(points / self.cells.edge).astype(np.int64) - low
        inside = ((at >= 0) & (at < shape)).all(1)
        inside[inside] = present[tuple(at[inside].T)]
        return inside

    def window(self, grid: CellGrid) -> GridWindow:
        """Where its own cells are on a grid, and a voxel around them."""
        own, voxel = np.array(sorted(self.own)), self.tsdf.settings.voxel
        box = np.stack([own.min(0) * self.cells.edge, (own.max(0) + 1) * self.cells.edge]) + self.tsdf.origin
        corners = np.stack(np.meshgrid(*box.T, indexing="ij"), -1).reshape(-1, 3)
        at = grid.plane.coordinates(corners)[:, :2]
        return grid.window(at.min(0) - 2 * voxel, at.max(0) + 2 * voxel)


class CellField:
    """The field.

    Args:
        pager: all of whose cells are on disk.
        settings: how far distances are computed.

    Attributes:
        settings: the same.
        memory_bytes: the most that a part of it has taken so far.
    """

    def __init__(self, pager: CellPager, settings: FieldSettings) -> None:
        self.pager, self.settings, self.memory_bytes = pager, settings, 0
        self._coordinates = pager.coordinates()

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self._coordinates)

    @property
    def voxel(self) -> float:
        """Edge of a voxel, metres."""
        return self.pager.tsdf.settings.voxel

    @property
    def origin(self) -> np.ndarray:
        """Where in the world blocks are counted from, float64 [3], metres."""
        return self.pager.tsdf.origin

    def coordinates(self) -> np.ndarray:
        """Coordinates of all blocks from the origin, int32 [B, 3]."""
        return self._coordinates

    def query(self, points: np.ndarray) -> FieldValues:
        """Distances and gradients at points [N, 3], see `DistanceField.query`; cells around them are read anew."""
        nowhere = DistanceField(TsdfMap(self.pager.tsdf.settings, self.pager.tsdf.context, self.origin), self.settings)
        found = nowhere.query(points)
        from_origin = np.asarray(points, np.float64) - self.origin
        finite = np.isfinite(from_origin).all(1)
        keys = as_keys(np.unique(np.floor(from_origin[finite] / self.pager.cells.edge).astype(np.int64), axis=0))
        for part in self._parts(keys & self.pager.keys(), self.settings.max_distance):
            rows = np.flatnonzero(finite)[part.owns(from_origin[finite])]
            values = part.field.query(points[rows])
            for name in ("distance", "gradient", "known", "stale"):
                getattr(found, name)[rows] = getattr(values, name)
            self._note(part)
        return found

    def parts(self, plane: SlicePlane, low: float, high: float, reach: float | None = None) -> Iterator[FieldPart]:
        """The cells that have something between two heights above a plane, or a voxel beside, a few at a time.

        Args:
            plane: its normal is up.
            low, high: metres.
            reach: largest distance that is computed, metres; None: no field is wanted.
        """
        keys = np.array(sorted(self.pager.keys())).reshape(-1, 3)
        edge = self.pager.cells.edge
        middles = plane.coordinates((keys + 0.5) * edge + self.origin)[:, 2]
        beside = edge / 2 * np.abs(plane.normal).sum() + self.voxel
        for part in self._parts(as_keys(keys[(middles >= low - beside) & (middles <= high + beside)]), reach):
            yield part
            self._note(part)

    def _parts(self, keys: set[CellKey], reach: float | None) -> Iterator[FieldPart]:
        margin = HeldDistanceTuning.margin_voxels * self.voxel
        around = 0 if reach is None else math.ceil((reach + margin) / self.pager.cells.edge)
        settings = replace(self.settings, max_distance=reach or self.settings.max_distance)
        for _, own in boxes_of(keys, CellFieldTuning.side):
            tsdf = in_memory(self.pager, with_neighbours(own, around) & self.pager.keys())
            yield FieldPart(self.pager.cells, own, tsdf, settings)

    def _note(self, part: FieldPart) -> None:
        if "field" in vars(part):
            self.memory_bytes = max(self.memory_bytes, part.field.memory_bytes)


AnyField = DistanceField | CellField
"""Of which slices and maps are made."""
