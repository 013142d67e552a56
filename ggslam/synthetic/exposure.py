# SPDX-License-Identifier: Apache-2.0
"""Colour images of a camera that moves while its shutter is open."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

MOMENTS = 5
"""Views that one exposure is the mean of."""


def poses_during(poses: np.ndarray, frame: int, share: float) -> np.ndarray:
    """T_world_camera, float64 [MOMENTS, 4, 4], evenly over an exposure about the frame's own moment.

    Args:
        poses: of all frames, [n, 4, 4].
        frame: which one.
        share: of the time between two frames for which the shutter is open, 0 to 1.
    """
    around = np.clip([frame - 1, frame, frame + 1], 0, len(poses) - 1)
    times = frame + share * np.linspace(-0.5, 0.5, MOMENTS)
    before = np.minimum(times, frame)
    found = np.tile(np.eye(4), (MOMENTS, 1, 1))
    rotations = Rotation.from_matrix(poses[around, :3, :3])
    found[:, :3, :3] = Slerp([frame - 1, frame, frame + 1], rotations)(times).as_matrix()
    left, middle, right = poses[around, :3, 3]
    found[:, :3, 3] = (
        middle + (frame - before)[:, None] * (left - middle) + (times - before)[:, None] * (right - middle)
    )
    return found


def exposed_color(
    render: Callable[[np.ndarray], np.ndarray], poses: np.ndarray, frame: int, share: float
) -> np.ndarray:  # fmt: skip
    """Colour uint8 [H, W, 3] of a frame, blurred by the camera's motion; see `poses_during`.

    Args:
        render: colour uint8 [H, W, 3] of a pose [4, 4].
    """
    views = [render(pose).astype(np.float32) for pose in poses_during(poses, frame, share)]
    return np.rint(np.mean(views, 0)).astype(np.uint8)
