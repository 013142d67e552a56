# SPDX-License-Identifier: Apache-2.0
"""Voxels as whole numbers: equal for points of one voxel, and sorted by x, then y, then z."""

from __future__ import annotations

from typing import Final

import numpy as np

_BITS: Final = 21
"""Bits of a voxel coordinate in a key of 64 bits."""
_OFFSET: Final = 1 << 20
"""Added to voxel coordinates to make them positive."""


def voxel_keys(points: np.ndarray, voxel: float) -> np.ndarray:
    """The voxel of each point [n, 3], int64 [n]; edge `voxel` metres, coordinates up to a million voxels."""
    cells = np.floor(points / voxel).astype(np.int64) + _OFFSET
    return (cells[:, 0] << 2 * _BITS) | (cells[:, 1] << _BITS) | cells[:, 2]


def voxel_centres(keys: np.ndarray, voxel: float) -> np.ndarray:
    """The middles of voxels, float64 [n, 3] metres."""
    mask = (1 << _BITS) - 1
    cells = np.stack([keys >> 2 * _BITS, (keys >> _BITS) & mask, keys & mask], 1) - _OFFSET
    return (cells + 0.5) * voxel


def neighbour_step(x: int, y: int, z: int) -> int:
    """What leads from a voxel's key to that of the one so many voxels away."""
    return (x << 2 * _BITS) + (y << _BITS) + z
