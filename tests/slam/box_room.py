# SPDX-License-Identifier: Apache-2.0
"""A corner of two walls and a floor with a texture, before it a red box that may be anywhere."""

from __future__ import annotations

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.slam.slam import Slam

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
QUICK = [
    "mapping.iterations_per_frame=2", "mapping.first_frame_iterations=20", "refine_iterations=0",
    "masks.source=none", "keyframes.max_gap=5", "tracking.noise={constant: 0.001, square: 0.0}",
]  # fmt: skip
RED = np.array([220, 20, 20], np.uint8)


def pose(x: float) -> np.ndarray:
    """T_world_camera [4, 4] so many metres to the right."""
    T = np.eye(4)
    T[0, 3] = x
    return T


def picture(n: int, x: float, box_x: float) -> Frame:
    """Frame n, seen from x metres to the right, with the middle of the box `box_x` metres to the right."""
    rays, origin = CAMERA.rays().reshape(-1, 3).astype(float), pose(x)[:3, 3]
    best, color = np.full(len(rays), np.inf), np.zeros((len(rays), 3))
    for normal, distance, tint in (((0, 0, 1), 3.0, 1.0), ((0, 1, 0), 0.8, 0.8), ((0.8, 0, 0.6), 2.6, 0.6)):
        n_hat = np.array(normal, float)
        t = (distance - origin @ n_hat) / np.where(np.abs(rays @ n_hat) > 1e-9, rays @ n_hat, 1e-9)
        hit = (t > 0) & (t < best)
        at = origin + t[:, None] * rays
        shade = 0.5 + 0.2 * np.sin(9 * at[:, 0]) + 0.15 * np.cos(13 * at[:, 1]) + 0.15 * np.sin(11 * at[:, 2])
        best = np.where(hit, t, best)
        color = np.where(hit[:, None], tint * 255 * shade[:, None] * [0.7, 0.9, 1.0], color)
    t = 1.5 - origin[2]
    at = origin + t * rays
    box = (np.abs(at[:, 0] - box_x) < 0.2) & (np.abs(at[:, 1]) < 0.2) & (t < best)
    best, color = np.where(box, t, best), np.where(box[:, None], RED, color)
    shape = (CAMERA.height, CAMERA.width)
    return Frame(
        n, n, n / 30, color.clip(0, 255).astype(np.uint8).reshape(*shape, 3),
        best.astype(np.float32).reshape(shape), CAMERA, T_world_camera=pose(x),
    )  # fmt: skip


def red_share(slam: Slam, n: int) -> float:
    """Share of the rendered image at frame n that is red."""
    view = slam.mapper.render_view(CAMERA, np.linalg.inv(slam.pose_of(slam.frames[n])))
    image = view.image.numpy()
    return float(((image[0] > 0.6) & (image[1] < 0.3)).mean())
