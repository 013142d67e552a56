# SPDX-License-Identifier: Apache-2.0
"""Predicts a depth image from a nearby pose."""

from __future__ import annotations

import math

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse

_WHERE_IT_WAS = np.eye(4)


def largest_shift(T_new_old: np.ndarray, camera: Camera, depth_m: float) -> float:
    """About how many pixels what is seen at a depth (metres) shifts in the image when the camera makes a motion
    [4, 4]."""
    return shift_between(_WHERE_IT_WAS, T_new_old, camera, depth_m)


def shift_between(T_world_new: np.ndarray, T_world_old: np.ndarray, camera: Camera, depth_m: float) -> float:
    """The same when it moves from one pose [4, 4] to another."""
    back = T_world_new[:3, :3].T
    # Numbers: arrays of four corners cost several times as much.
    (a, b, c), (d, e, f), (g, h, i) = (back @ T_world_old[:3, :3]).tolist()
    tx, ty, tz = (back @ (T_world_old[:3, 3] - T_world_new[:3, 3])).tolist()
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    largest, z = 0.0, depth_m
    for u in (0, camera.width - 1):
        x = (u - cx) / fx * z
        for v in (0, camera.height - 1):
            y = (v - cy) / fy * z
            ahead = g * x + h * y + i * z + tz
            if ahead < 1e-6:
                ahead = 1e-6
            off_u = (a * x + b * y + c * z + tx) / ahead * fx + cx - u
            off_v = (d * x + e * y + f * z + ty) / ahead * fy + cy - v
            largest = max(off_u * off_u + off_v * off_v, largest)  # NaN stays
    return math.sqrt(largest)


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
