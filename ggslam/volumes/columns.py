# SPDX-License-Identifier: Apache-2.0
"""What a TSDF knows above the cells of a plane, layer by layer."""

from __future__ import annotations

import ctypes

import numpy as np

from ggslam.abi.core import ColumnGrid
from ggslam.native.loader import load_library
from ggslam.volumes.cell_grid import CellGrid, GridWindow
from ggslam.volumes.tsdf import TsdfMap


def seen_above(
    tsdf: TsdfMap, grid: CellGrid, first: float, spacing: float, layers: int, window: GridWindow | None = None
) -> np.ndarray:
    """What the voxels are that the cells' centres lie in at some heights, uint8 [layers, H, W]: SEEN_BIT if a view has
    seen the voxel, BEHIND_BIT if it is behind a surface.

    Args:
        tsdf: the map.
        grid: of the cells.
        first: height of the lowest layer above the plane, metres.
        spacing: between layers, metres.
        layers: their number.
        window: of the grid; None: all of it.
    """
    plane, voxel = grid.plane, tsdf.settings.voxel
    corner = plane.origin - tsdf.origin + (plane.low[0] + grid.resolution / 2) * plane.x_axis
    start = corner + (plane.low[1] + (grid.shape[0] - 0.5) * grid.resolution) * plane.y_axis + first * plane.normal
    steps = (spacing * plane.normal, -grid.resolution * plane.y_axis, grid.resolution * plane.x_axis)
    vectors = [tuple((np.asarray(v, np.float64) / voxel).tolist()) for v in (start, *steps)]
    of = window or grid.whole
    seen = np.empty((layers, *of.shape), np.uint8)
    cells = ColumnGrid(*vectors, layers, *of.shape, of.first_row, of.first_column)
    load_library().ggslam_tsdf_columns(tsdf.handle, tsdf.context.handle, ctypes.byref(cells), seen.ctypes.data)
    return seen
