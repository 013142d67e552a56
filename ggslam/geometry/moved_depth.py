# SPDX-License-Identifier: Apache-2.0
"""Predicts a depth image from a nearby pose."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse


def largest_shift(T_new_old: np.ndarray, camera: Camera, depth_m: float) -> float:
    """About how many pixels what is seen at a depth (metres) shifts in the image when the camera makes a motion
    [4, 4]."""
    corners, rays = _corners(camera)
    moved = depth_m * rays @ T_new_old[:3, :3].T + T_new_old[:3, 3]
    seen = moved[:, :2] / np.maximum(moved[:, 2:], 1e-6) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    apart = seen - corners
    return math.sqrt(np.add.reduce(apart * apart, axis=1).max())


@lru_cache(maxsize=8)
def _corners(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The pixels at an image's corners [4, 2] and their rays [4, 3]."""
    corners = np.array([[u, v] for u in (0, camera.width - 1) for v in (0, camera.height - 1)], float)
    return corners, np.column_stack([(corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy), np.ones(4)])


def moved_depth(depth: np.ndarray, camera: Camera, T_new_old: np.ndarray) -> np.ndarray:
    """Depth as seen by a camera that was moved a little, float32 [H, W].

    Every pixel looks up where the old camera saw it, taking its depth to be about what the old image has at the same
    pixel: exact for turns, and for shifts of the camera but for a pixel or two along outlines. Nothing is mixed.

    Args:
        depth: float32 [H, W], metres, 0 where unknown.
        camera: of both images.
        T_new_old: [4, 4], from the old camera's frame to the new one's.
    """
    known = depth > 0
    if not known.any():
        return depth
    guess = np.where(known, depth, np.float32(np.median(depth[known]))).astype(np.float32)
    back, rays = inverse(T_new_old).astype(np.float32), camera.rays()
    x, y, z = np.moveaxis((rays * guess[..., None]) @ back[:3, :3].T + back[:3, 3], -1, 0)
    ahead = z > 1e-3
    z = np.where(ahead, z, 1)
    columns = np.rint(camera.fx * x / z + camera.cx).astype(int)
    rows = np.rint(camera.fy * y / z + camera.cy).astype(int)
    inside = ahead & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    columns, rows = np.where(inside, columns, 0), np.where(inside, rows, 0)
    found = np.where(inside, depth[rows, columns], 0)
    forward = T_new_old[2].astype(np.float32)
    new = found * (rays[rows, columns] @ forward[:3]) + forward[3]
    return np.where((found > 0) & (new > 0), new, 0).astype(np.float32)
