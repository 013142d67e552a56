# SPDX-License-Identifier: Apache-2.0
"""Grids as nav_msgs/OccupancyGrid, and parts of them as map_msgs/OccupancyGridUpdate."""

from __future__ import annotations

from typing import Final

import numpy as np

from ggslam.messages.contents import Grid
from ggslam.messages.ros2_geometry import pose
from ggslam.messages.ros2_images import header, stamp_of
from ggslam.messages.sound_content import plain_text
from ggslam.middleware.types import MessageTypes

GRID: Final = "nav_msgs/msg/OccupancyGrid"
GRID_UPDATE: Final = "map_msgs/msg/OccupancyGridUpdate"


def grid_message(types: MessageTypes, grid: Grid, stamp: float) -> bytes:
    """nav_msgs/OccupancyGrid of a whole grid."""
    info = types.make(
        "nav_msgs/msg/MapMetaData", map_load_time=stamp_of(types, stamp), resolution=grid.cell_m,
        width=grid.cells.shape[1], height=grid.cells.shape[0], origin=pose(types, grid.T_frame_origin),
    )  # fmt: skip
    made = types.make(GRID, header=header(types, plain_text(grid.frame), stamp), info=info, data=_cells(grid))
    return types.encode(GRID, made)


def grid_update_message(types: MessageTypes, grid: Grid, stamp: float) -> bytes:
    """map_msgs/OccupancyGridUpdate of a part of a grid, at its row and column."""
    row, column = grid.at or (0, 0)
    made = types.make(
        GRID_UPDATE, header=header(types, plain_text(grid.frame), stamp), x=column, y=row, width=grid.cells.shape[1],
        height=grid.cells.shape[0], data=_cells(grid),
    )  # fmt: skip
    return types.encode(GRID_UPDATE, made)


def _cells(grid: Grid) -> np.ndarray:
    return np.ascontiguousarray(grid.cells, np.int8).reshape(-1)
