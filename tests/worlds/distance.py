# SPDX-License-Identifier: Apache-2.0
"""How far points are from the surfaces of a generated world."""

from __future__ import annotations

import numpy as np

from worlds.world import World

NEAR = 0.45
"""Metres within which distances are exact; cells of the grid are a metre wide."""
_AT_ONCE = 20_000


def world_distance(world: World, points: np.ndarray) -> np.ndarray:
    """Signed distance [n] of points [n, 3] from the nearest surface of boxes, floor or ceiling, negative inside; exact
    up to `NEAR`, larger where it is more."""
    points = np.asarray(points, np.float64)
    found = np.minimum(points[:, 2], world.height - points[:, 2])
    corners = [(x, y) for x in (-NEAR, NEAR) for y in (-NEAR, NEAR)]
    for begin in range(0, len(points), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        for corner in corners:  # all cells that are so near
            point, box = world.grid.candidates(world.grid.cells(points[part, :2] + corner))
            np.minimum.at(found[part], point, _box_distance(points[part][point], world.table[box]))
    return found


def _box_distance(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Of points [n, 3] from boxes [n, 8], row by row."""
    x, y, z = (points - boxes[:, :3]).T
    cosine, sine = boxes[:, 6:].T
    beyond = np.abs(np.stack([cosine * x + sine * y, cosine * y - sine * x, z], 1)) - boxes[:, 3:6]
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(1), 0)
