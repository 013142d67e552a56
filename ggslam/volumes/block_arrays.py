# SPDX-License-Identifier: Apache-2.0
"""Blocks of a TSDF as arrays, to be put into another one or a file."""

from __future__ import annotations

import numpy as np

from ggslam.volumes.tsdf import BlockList, TsdfMap

_NAMES = ("value", "weight", "color", "label", "votes")
_OF_POINTS = ("hits", "octants")


def take_blocks(tsdf: TsdfMap, blocks: BlockList, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Some of a map's blocks, sorted: `dense` [n, 3] with their voxels, `free` [m, 3] with `free_weight` [m].

    Args:
        tsdf: the map.
        blocks: all of its blocks.
        rows: numbers of the blocks among them.
    """
    rows = rows[np.lexsort(blocks.coordinates[rows].T)]
    at, dense = blocks.coordinates[rows], blocks.dense[rows]
    voxels = tsdf.read(at[dense])
    names = _NAMES + (_OF_POINTS if tsdf.points else ())
    found = {"dense": at[dense], "free": at[~dense], "free_weight": blocks.free_weight[rows][~dense]}
    return {**found, **{name: getattr(voxels, name) for name in names}}


def put_blocks(tsdf: TsdfMap, arrays: dict[str, np.ndarray]) -> None:
    """Puts blocks into a map that has none at their places."""
    names = _NAMES + (_OF_POINTS if tsdf.points else ())
    tsdf.write(arrays["dense"], **{name: arrays[name] for name in names})
    tsdf.write_free(arrays["free"], arrays["free_weight"])


def decay_blocks(arrays: dict[str, np.ndarray], like: TsdfMap, times: int) -> dict[str, np.ndarray]:
    """What remains of blocks of a map after its weights decayed so many times more."""
    if not times:
        return arrays
    alone = TsdfMap(like.settings, like.context, np.zeros(3), like.points)
    put_blocks(alone, arrays)
    for _ in range(times):
        alone.decay()
    blocks = alone.blocks()
    return take_blocks(alone, blocks, np.arange(len(blocks.coordinates)))
