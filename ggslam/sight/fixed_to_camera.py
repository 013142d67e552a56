# SPDX-License-Identifier: Apache-2.0
"""Detects what is fixed to the camera (the tool of a robot, the bonnet of a car): it is in every image at the same
place.

It does not belong to the world: one looks through where it was a moment ago, and it is where it was in the image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import transform_points
from ggslam.sight.margin import Margin
from ggslam.sight.view import Sight, View
from ggslam.system.tuning import Tuning

SAME = Margin.usual()
PAST = SAME.times(3)
"""The other view has to look past a surface by more than one margin: small images have the nearest depth of each cell,
so that slanted surfaces and outlines differ by more. Of pixels of the world half as many are taken for fixed so."""


class FixedTuning(Tuning):
    """What two views tell about what is fixed to the camera."""

    min_shift = 0.03
    """Smallest expected shift of a world point between two views, as a share of the image width."""


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
    view = View.of(other, camera, np.eye(4), SAME)
    moved = transform_points(camera.back_project(depth).reshape(-1, 3).astype(float), T_other_camera)
    z = np.maximum(moved[:, 2], 1e-3)
    u, v = (f * moved[:, k] / z + c for k, f, c in ((0, camera.fx, camera.cx), (1, camera.fy, camera.cy)))
    rows, columns = np.mgrid[: camera.height, : camera.width]
    shift = np.hypot(u.reshape(depth.shape) - columns, v.reshape(depth.shape) - rows)
    moves = (depth > 0) & (shift > FixedTuning.min_shift * camera.width)
    still = moves & (view.classify_depth(depth) == Sight.SAME)
    past = replace(view, margin=PAST).classify_points(moved).before.reshape(depth.shape)
    world = moves & view.classify_points(moved).same.reshape(depth.shape)
    return PairEvidence(still & past, still, world)
