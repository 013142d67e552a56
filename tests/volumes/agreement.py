# SPDX-License-Identifier: Apache-2.0
"""How far two occupancy maps agree, voxel by voxel."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from ggslam.errors import InputError
from ggslam.native.loader import load_library
from ggslam.volumes.occupancy import OccupancyMap


@dataclass(frozen=True)
class Agreement:
    """Shares of voxels of the finest level; not a number where there are no voxels to count.

    Attributes:
        known: of the voxels known to both maps, those with the same state (free or occupied).
        union: of the voxels known to either map, those with the same state; known to one alone counts as different.
        occupied: of the voxels occupied in the reference, those occupied in the other.
        counts: int64 [3, 3], voxels by their state in the reference (row) and in the other (column): unknown, free,
            occupied.
    """

    known: float
    union: float
    occupied: float
    counts: np.ndarray


def agreement(reference: OccupancyMap, other: OccupancyMap) -> Agreement:
    """Compares two maps of one resolution, usually the unquantised update (`quantize=False`) with the quantised one.

    Raises:
        InputError: the maps have different resolutions or origins.
    """
    if reference.resolution != other.resolution:
        raise InputError(f"maps of one resolution expected, found {reference.resolution} and {other.resolution} m")
    if (reference.origin != other.origin).any():
        raise InputError(f"maps of one origin expected, found {reference.origin.tolist()} and {other.origin.tolist()}")
    counts = (ctypes.c_uint64 * 9)()
    load_library().ggslam_occupancy_compare(
        reference.handle, other.handle, reference.settings.threshold, other.settings.threshold, counts
    )
    table = np.array(counts[:], np.int64).reshape(3, 3)
    same = table[1, 1] + table[2, 2]
    return Agreement(
        _share(same, table[1:, 1:].sum()),
        _share(same, table.sum() - table[0, 0]),
        _share(table[2, 2], table[2].sum()),
        table,
    )


def _share(part: int, whole: int) -> float:
    return float(part) / float(whole) if whole else float("nan")
