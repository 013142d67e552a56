# SPDX-License-Identifier: Apache-2.0
"""A room of exact geometry that looks the same from no two sides, as a volume, and a reader of maps that knows nothing
of ggslam: written from what map_server publishes of its files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import FREE_VALUE, FULL_WEIGHT, SIDE, VOXELS, TsdfMap

SIZE = np.array([4.31, 3.07, 2.2])
"""The room is from zero to here, metres, in the floor's frame: z up."""
BOXES = (
    ((0.93, 0.52, 0.0), (1.71, 0.97, 0.31)),
    ((3.02, 1.83, 0.0), (3.53, 3.07, 1.9)),
    ((0.4, 2.21, 0.74), (1.6, 2.83, 0.78)),
)
"""A low box, a cupboard at the upper wall on the right, a table's top at the upper left."""


def room_distance(p: np.ndarray) -> np.ndarray:
    """Signed distances [N] of points [N, 3] of the floor's frame, positive in free space."""
    inside = np.minimum(p, SIZE - p).min(-1)
    found = [inside]
    for low, high in BOXES:
        middle, half = (np.array(low) + high) / 2, (np.array(high) - low) / 2
        q = np.abs(p - middle) - half
        found.append(np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0))
    return np.min(found, axis=0)


def wall_distance(places: np.ndarray, low: float, high: float) -> np.ndarray:
    """Metres across the floor from places [N, 2] to the nearest of the room's surfaces that reach into a band of
    heights."""
    gaps = [places[:, 0], SIZE[0] - places[:, 0], places[:, 1], SIZE[1] - places[:, 1]]
    for (x0, y0, z0), (x1, y1, z1) in BOXES:
        if z0 <= high and z1 >= low:
            q = np.abs(places - [(x0 + x1) / 2, (y0 + y1) / 2]) - [(x1 - x0) / 2, (y1 - y0) / 2]
            gaps.append(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0))
    return np.min(gaps, axis=0)


def turned(
    degrees: float = 37.0, tilt: float = 4.0, shift: tuple[float, float, float] = (0.7, -1.9, 0.4)
) -> np.ndarray:
    """T_floor_map of a map that lies askew."""
    a, b = np.radians([degrees, tilt])
    yaw = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    roll = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = yaw @ roll, shift
    return T


def room_field(
    T_floor_map: np.ndarray,
    voxel: float = 0.04,
    distance_of: Callable[[np.ndarray], np.ndarray] = room_distance,
    deepest: float = 0.0,
) -> DistanceField:
    """The room, or what `distance_of` says of points [N, 3] down to z = -`deepest`, as a volume in the map's frame;
    known up to the truncation behind its surfaces."""
    tsdf = TsdfMap(TsdfSettings(voxel=voxel))
    corners = np.array([[x, y, z] for x in (-0.2, 4.51) for y in (-0.2, 3.27) for z in (-0.2 - deepest, 2.4)])
    R, t = T_floor_map[:3, :3], T_floor_map[:3, 3]
    own, edge = (corners - t) @ R, SIDE * voxel
    ranges = [np.arange(np.floor(a), np.ceil(b)) for a, b in zip(own.min(0) / edge, own.max(0) / edge, strict=True)]
    blocks = np.stack(np.meshgrid(*ranges, indexing="ij"), -1).reshape(-1, 3).astype(np.int32)
    k, j, i = np.unravel_index(np.arange(VOXELS), (SIDE,) * 3)
    centres = (blocks[:, None] * SIDE + np.stack([i, j, k], -1)[None] + 0.5) * voxel
    distance = distance_of(centres.reshape(-1, 3) @ R.T + t).reshape(len(blocks), VOXELS)
    limit = tsdf.settings.truncation
    value = np.rint(np.clip(distance / limit, -1, 1) * FREE_VALUE)
    free = (value == FREE_VALUE).all(1)
    tsdf.write(blocks[~free], value=value[~free], weight=np.where(distance[~free] >= -limit, FULL_WEIGHT, 0))
    tsdf.write_free(blocks[free], np.full(free.sum(), FULL_WEIGHT))
    field = DistanceField(tsdf)
    field.update()
    return field


def read_map(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    """A map as map_server loads it: occupancy int [H, W] with row 0 at the BOTTOM (-1 unknown, 0 free ... 100
    occupied), as of a nav_msgs/OccupancyGrid, and what the yaml says."""
    told = yaml.safe_load(path.read_text())
    pixels = cv2.imread(str(path.parent / told["image"]), cv2.IMREAD_UNCHANGED)
    alpha = pixels[..., 3] if pixels.ndim == 3 and pixels.shape[2] == 4 else np.full(pixels.shape[:2], 255, np.uint8)
    grey = pixels.astype(float) if pixels.ndim == 2 else pixels[..., :3].astype(float).mean(2)
    return occupancy(grey, alpha, told)[::-1], told


def occupancy(grey: np.ndarray, alpha: np.ndarray, told: dict[str, Any]) -> np.ndarray:
    """What map_server makes of pixels."""
    shade = grey / 255
    p = shade if told["negate"] else 1 - shade
    mode, occupied, free = told["mode"], told["occupied_thresh"], told["free_thresh"]
    if mode == "raw":
        return np.where(np.rint(shade * 255) <= 100, np.rint(shade * 255), -1).astype(int)
    between = np.full(p.shape, -1)
    if mode == "scale":
        between = np.rint((p - free) / (occupied - free) * 100).astype(int)
    found = np.where(p > occupied, 100, np.where(p < free, 0, between))
    return np.where(alpha < 255, -1, found) if mode == "scale" else found


def value_at(grid: np.ndarray, told: dict[str, Any], x: float, y: float) -> int:
    """The cell that a place of the map's frame is in: row 0 begins at the origin's y."""
    x0, y0, yaw = told["origin"]
    assert yaw == 0
    return int(grid[int((y - y0) / told["resolution"]), int((x - x0) / told["resolution"])])


def centres_of(grid: np.ndarray, told: dict[str, Any]) -> np.ndarray:
    """Where the cells' centres are in the map's frame, [H, W, 2]."""
    x = told["origin"][0] + (np.arange(grid.shape[1]) + 0.5) * told["resolution"]
    y = told["origin"][1] + (np.arange(grid.shape[0]) + 0.5) * told["resolution"]
    return np.stack(np.meshgrid(x, y), -1)


def costs_of(values: np.ndarray) -> np.ndarray:
    """What nav2's static layer makes of an occupancy grid with `trinary_costmap: false` and a lethal threshold of
    100."""
    return np.where(values < 0, 255, np.where(values >= 100, 254, (values / 100 * 254).astype(int)))
