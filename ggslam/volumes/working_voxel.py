# SPDX-License-Identifier: Apache-2.0
"""Finds the smallest voxel that a view can be fused with, for an error about voxels that are too small."""

from __future__ import annotations

from collections.abc import Callable

from ggslam.errors import InputError
from ggslam.system.tuning import Tuning


class WorkingVoxelTuning(Tuning):
    """Which voxels are proposed."""

    edges = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002)
    """Edges of voxels that are tried, in metres."""
    max_blocks = 100_000
    """Most blocks of a view; 5 KB each."""


def working_voxel(blocks_of: Callable[[float], int], asked: float) -> float | None:
    """The smallest of `WorkingVoxelTuning.edges`, larger than the one asked for, with which a view takes at most
    `WorkingVoxelTuning.max_blocks`; None if even the largest is too small.

    Args:
        blocks_of: fuses the view with voxels of an edge in metres; returns the number of blocks, or raises InputError.
        asked: metres.
    """
    found = None
    for edge in WorkingVoxelTuning.edges:  # from the largest on: each takes several times as long as the one before
        if edge <= asked or not _fits(blocks_of, edge):
            break
        found = edge
    return found


def _fits(blocks_of: Callable[[float], int], edge: float) -> bool:
    try:
        return blocks_of(edge) <= WorkingVoxelTuning.max_blocks
    except InputError:
        return False
