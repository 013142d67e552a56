# SPDX-License-Identifier: Apache-2.0
"""What is fixed to the camera: the tool of a robot, the bonnet of a car, whatever is in every image at the same place.

It does not belong to the world: one looks through where it was a moment ago, and it is where it was in the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import transform_points

SAME = 0.03
"""Depths that differ by less than this share are of the same surface."""
BEHIND = 0.15
"""Depth that is larger by this share than a surface's is seen through where the surface would have to be."""
LEAST_SHIFT = 0.03
"""Of the image's width: what would have to move less says nothing."""


@dataclass(frozen=True)
class PairEvidence:
    """What two views say of each pixel of the first, bool [h, w] each.

    Attributes:
        fixed: its surface is fixed to the camera: it is where it was in the image, and the other view looks through
            where it would be in the world.
        still: its depth is what it was in the image, though as a part of the world it would be elsewhere.
        world: its surface is where a part of the world has to be.
    """

    fixed: np.ndarray
    still: np.ndarray
    world: np.ndarray


def shrink_depth(depth: np.ndarray, camera: Camera, factor: int) -> tuple[np.ndarray, Camera]:
    """Depth `factor` times smaller, the nearest of each cell that is known (rows and columns left over are cut), and
    its camera."""
    h, w = camera.height // factor, camera.width // factor
    cells = np.where(depth > 0, depth, np.inf)[: h * factor, : w * factor].reshape(h, factor, w, factor).min((1, 3))
    middle = (factor - 1) / 2
    smaller = Camera(
        w, h, camera.fx / factor, camera.fy / factor, (camera.cx - middle) / factor, (camera.cy - middle) / factor
    )
    return np.where(np.isfinite(cells), cells, 0).astype(np.float32), smaller


def compare_views(depth: np.ndarray, other: np.ndarray, T_other_camera: np.ndarray, camera: Camera) -> PairEvidence:
    """Compares two views of one camera.

    Args:
        depth: of a frame, float32 [h, w], metres, 0 where unknown.
        other: the same of another frame.
        T_other_camera: [4, 4], from the first camera's frame to the other's.
        camera: of both.
    """
    moved = transform_points(camera.back_project(depth).reshape(-1, 3), T_other_camera).reshape(*depth.shape, 3)
    z = np.maximum(moved[..., 2], 1e-3)
    u = np.rint(camera.fx * moved[..., 0] / z + camera.cx)
    v = np.rint(camera.fy * moved[..., 1] / z + camera.cy)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    moves = (depth > 0) & (np.hypot(u - columns, v - rows) > LEAST_SHIFT * camera.width)
    still = moves & (np.abs(other - depth) < SAME * depth)
    inside = moves & (moved[..., 2] > 1e-3) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    seen = other[np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int)]
    inside &= seen > 0
    return PairEvidence(still & inside & (seen > (1 + BEHIND) * z), still, inside & (np.abs(seen - z) < SAME * z))
