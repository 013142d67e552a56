# SPDX-License-Identifier: Apache-2.0
"""Distances of a map that is partly on disk: which of them are those of the whole map, and what is sure of the others.

The distance field knows the surfaces of the cells in memory. The nearest surface on disk is no nearer than the nearest
cell on disk, so a distance shorter than that is the whole map's, and a longer one is too long by no more than what it
has beyond. Cells around a view stay in memory as far as distances reach: all of its own are the whole map's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ggslam.system.tuning import Tuning
from ggslam.volumes.esdf import FieldValues
from ggslam.volumes.volume_cells import CellKey, VolumeCells, as_keys, with_neighbours


class HeldDistanceTuning(Tuning):
    """What is sure beside cells on disk."""

    margin_voxels = 2.0
    """Voxels beside a cell on disk in which surfaces may be missing or have other edges: a surface point needs the
    voxels around its own, and its disc reaches 0.7 voxels from it."""
    points_at_once = 1 << 14
    """Points whose distances from cells are computed together."""


@dataclass(frozen=True)
class HeldValues(FieldValues):
    """Answers of `VolumeMaps.query`.

    Attributes:
        exact: bool [N], whether the distance is the whole map's (within 1/8 voxel, see `DistanceField.update`); not
            where `stale` is set.
        at_least: float32 [N], metres: the whole map's distance is no shorter (behind a surface: no farther behind); NaN
            where not known or stale: a surface may have come.
    """

    exact: np.ndarray
    at_least: np.ndarray


def held_values(values: FieldValues, border: np.ndarray, voxel: float) -> HeldValues:
    """What the field of what is in memory answered, and how sure it is.

    Args:
        values: of the field, at some points.
        border: metres [N] from each of them to the nearest cell that is not in memory, see `distance_to_cells`.
        voxel: metres.
    """
    sure = np.maximum(border - HeldDistanceTuning.margin_voxels * voxel, 0.0)
    far = np.abs(values.distance)
    at_least = np.copysign(np.minimum(far, sure), values.distance).astype(np.float32)
    at_least[values.stale] = np.nan
    exact = values.known & ~values.stale & (far <= sure)
    return HeldValues(values.distance, values.gradient, values.known, values.stale, exact, at_least)


def distance_to_cells(
    points: np.ndarray, cells: VolumeCells, most: float, among: Callable[[set[CellKey]], set[CellKey]]
) -> np.ndarray:
    """Metres [N] from points to the nearest of some cells; infinite where that is farther than `most`.

    Args:
        points: [N, 3] from the origin of the cells, metres.
        cells: the grid.
        most: metres.
        among: gives those of some cells that count.
    """
    found = np.full(len(points), np.inf)
    finite = np.flatnonzero(np.isfinite(points).all(1))
    if not len(finite):
        return found
    around = int(np.ceil(most / cells.edge))
    own = np.floor(points[finite] / cells.edge).astype(np.int64)
    present = np.array(sorted(among(with_neighbours(as_keys(np.unique(own, axis=0)), around)))).reshape(-1, 3)
    if not len(present):
        return found
    for begin in range(0, len(finite), HeldDistanceTuning.points_at_once):
        rows = finite[begin : begin + HeldDistanceTuning.points_at_once]
        at = points[rows]
        reached = (present * cells.edge <= at.max(0) + most) & ((present + 1) * cells.edge >= at.min(0) - most)
        for low in present[reached.all(1)] * cells.edge:
            beside = at - np.clip(at, low, low + cells.edge)
            found[rows] = np.minimum(found[rows], np.sqrt(np.einsum("nx,nx->n", beside, beside)))
    return np.where(found <= most, found, np.inf)
