# SPDX-License-Identifier: Apache-2.0
"""Common conventions of poses and how to convert them to ours: camera to world with OpenCV axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.poses import inverse, is_valid_pose, matrix_to_quaternion, quaternion_to_matrix

AXES = np.diag([1.0, -1.0, -1.0, 1.0])
OURS = "opencv"


def _reorder_quaternion(T: np.ndarray) -> np.ndarray:
    """The pose whose quaternion was written wxyz and read as xyzw."""
    w, x, y, z = matrix_to_quaternion(T[:3, :3])
    result = T.copy()
    result[:3, :3] = quaternion_to_matrix(np.array([x, y, z, w]))  # what was read as x is w, and so on
    return result


@dataclass(frozen=True)
class PoseConvention:
    """What a pose, read as if it were ours, really is.

    Attributes:
        description: in words.
        convert: float64 [4, 4] as read to T_world_camera.
    """

    description: str
    convert: Callable[[np.ndarray], np.ndarray]


CONVENTIONS: dict[str, PoseConvention] = {
    OURS: PoseConvention("camera to world with OpenCV axes", lambda T: T),
    "world-to-camera": PoseConvention("world to camera", inverse),
    "opengl": PoseConvention("OpenGL camera axes (y up, z back)", lambda T: T @ AXES),
    "world-to-camera-opengl": PoseConvention("world to camera with OpenGL axes", lambda T: inverse(AXES @ T)),
    "wxyz": PoseConvention("quaternions in the order wxyz", _reorder_quaternion),
    "world-to-camera-wxyz": PoseConvention(
        "world to camera with quaternions in the order wxyz", lambda T: inverse(_reorder_quaternion(T))
    ),
}
"""By the name that a user gives them."""


def convert_poses(poses: np.ndarray, convention: str) -> np.ndarray:
    """Poses of a convention as T_world_camera.

    Args:
        poses: float64 [n, 4, 4], read as if they were ours; NaN where unknown.
        convention: one of `CONVENTIONS`.

    Raises:
        SequenceError: no such convention.
    """
    if convention not in CONVENTIONS:
        raise SequenceError(f"unknown pose convention '{convention}'; known: {', '.join(CONVENTIONS)}")
    convert = CONVENTIONS[convention].convert
    return np.array([convert(T) if is_valid_pose(T) else T for T in poses]).reshape(-1, 4, 4)
