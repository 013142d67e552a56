# SPDX-License-Identifier: Apache-2.0
"""Where a TSDF holds measured points: eighths of voxels, each with a point of a surface in it."""

from __future__ import annotations

import numpy as np

from ggslam.system.tuning import Tuning
from ggslam.volumes.tsdf import OCCUPIED_HITS, SIDE, VOXELS, TsdfMap


class MeasuredPointTuning(Tuning):
    """How points are read."""

    blocks_at_once = 4096
    """Blocks that are read at a time."""


_VOXEL = np.stack(np.unravel_index(np.arange(VOXELS), (SIDE,) * 3)[::-1], 1)
_OCTANT = np.stack(np.unravel_index(np.arange(8), (2,) * 3)[::-1], 1)


def measured_octants(tsdf: TsdfMap) -> np.ndarray:
    """Centres of the octants of occupied voxels that points were measured in, float64 [N, 3], metres. An octant reaches
    a quarter of a voxel from its centre along each axis."""
    blocks = tsdf.blocks()
    dense, found = blocks.coordinates[blocks.dense], [np.zeros((0, 3))]
    for start in range(0, len(dense), MeasuredPointTuning.blocks_at_once):
        at = dense[start : start + MeasuredPointTuning.blocks_at_once]
        held = tsdf.read(at)
        bits = np.where(held.hits >= OCCUPIED_HITS, held.octants, 0)[:, :, None] >> np.arange(8) & 1
        block, voxel, octant = np.nonzero(bits)
        found.append(SIDE * at[block] + _VOXEL[voxel] + 0.25 + 0.5 * _OCTANT[octant])
    return np.concatenate(found) * tsdf.settings.voxel
