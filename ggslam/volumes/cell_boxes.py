# SPDX-License-Identifier: Apache-2.0
"""Boxes of cells that are read from disk at a time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ggslam.volumes.block_arrays import put_blocks
from ggslam.volumes.cell_pager import CellPager
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.volume_cells import CellKey, as_keys


def boxes_of(keys: set[CellKey], side: int) -> Iterator[tuple[CellKey, set[CellKey]]]:
    """Cells in boxes of `side` along an edge. These are named by their places along the axes, of which that with the
    most boxes comes first, and are in the order of their names: the fewest are between one and its neighbours."""
    if not keys:
        return
    rows = np.array(sorted(keys)).reshape(-1, 3)
    boxes = np.floor_divide(rows, side)
    axes = np.argsort(boxes.min(0) - boxes.max(0), kind="stable")
    names, box_of = np.unique(boxes[:, axes], axis=0, return_inverse=True)
    for number, (first, second, third) in enumerate(names.tolist()):
        yield (first, second, third), as_keys(rows[box_of.ravel() == number])


def in_memory(pager: CellPager, keys: set[CellKey]) -> TsdfMap:
    """A TSDF of some cells on disk, which stay there."""
    like = pager.tsdf
    part = TsdfMap(like.settings, like.context, like.origin, like.points)
    for key in sorted(keys):
        put_blocks(part, pager.arrays(key))
    return part
