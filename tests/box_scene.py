# SPDX-License-Identifier: Apache-2.0
"""A coloured box before a wall, seen by a camera that goes to the right, with exact poses."""

from __future__ import annotations

import numpy as np

from ggslam.movers.recent import RecentFrame
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp, transform_points

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
WALL, HALF = 3.0, np.array([0.16, 0.1, 0.13])


def camera_pose(n: int) -> np.ndarray:
    """A centimetre a frame."""
    T = np.eye(4)
    T[0, 3] = 0.01 * n - 0.2
    return T


def box_pose(x: float, angle: float, y: float = 0.0) -> np.ndarray:
    """1.5 m away, tilted, and turned about the vertical."""
    tilt, turn = (se3_exp(np.array([0, 0, 0, *axis])) for axis in ((0.5, 0, 0), (0, 0.4 + angle, 0)))
    T = tilt @ turn
    T[:3, 3] = x, y, 1.5
    return T


def render(n: int, boxes: list[tuple[np.ndarray, int]], ids: bool = True, noise: float = 0.0) -> Frame:
    """Frame n, with boxes at T_world_box [4, 4] and their ids in the mask."""
    T_world_camera = camera_pose(n)
    rays = CAMERA.back_project(np.ones((120, 160), np.float32)).reshape(-1, 3).astype(float)
    depth, color, mask = np.full(len(rays), WALL), np.full((len(rays), 3), 90.0), np.ones(len(rays), np.uint16)
    for T_world_box, number in boxes:
        T = inverse(T_world_box) @ T_world_camera
        start, way = T[:3, 3], rays @ T[:3, :3].T
        with np.errstate(divide="ignore"):
            sides = np.sort(np.stack([(-HALF - start) / way, (HALF - start) / way]), axis=0)
        near, far = sides[0].max(1), sides[1].min(1)
        hit = (near < far) & (near > 0) & (near < depth)
        depth[hit], mask[hit] = near[hit], number
        at = start + near[hit, None] * way[hit]
        color[hit] = 128 + 100 * np.sin(at * (40.0, 55.0, 48.0) + (0.0, 1.0, 2.0))
    if noise:
        depth += np.random.default_rng(n).normal(0, noise, depth.shape)
    images = depth.reshape(120, 160).astype(np.float32), color.reshape(120, 160, 3).astype(np.uint8)
    return Frame(n, n, n / 30, images[1], images[0], CAMERA, mask.reshape(120, 160) if ids else None)


def view_of(frame: Frame) -> RecentFrame:
    """As movers are followed in it."""
    return RecentFrame(frame, camera_pose(frame.index), lambda z: np.full_like(z, 0.006))


def error(T: np.ndarray, T_true: np.ndarray) -> tuple[float, float]:
    """Metres, at a box where it was first, and degrees between two motions [4, 4] of it."""
    middle = box_pose(0, 0)[:3, 3][None]
    apart = np.linalg.norm(transform_points(middle, T) - transform_points(middle, T_true))
    turn = (np.trace(T[:3, :3].T @ T_true[:3, :3]) - 1) / 2
    return float(apart), float(np.degrees(np.arccos(np.clip(turn, -1, 1))))
