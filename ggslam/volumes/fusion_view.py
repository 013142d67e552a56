# SPDX-License-Identifier: Apache-2.0
"""A view to be fused, checked."""

from __future__ import annotations

import numpy as np

from ggslam.abi.core import FusionInput
from ggslam.errors import InputError
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.system.tuning import Tuning


class PoseCheckTuning(Tuning):
    """When a pose is a rotation and a translation."""

    max_error = 0.02
    """Largest entry by which R^T R may differ from the unit matrix."""


class FusionView:
    """Images and pose of a view.

    Attributes:
        depth: float32 [H, W].
        color: uint8 [H, W, 3] or None.
        labels: uint16 [H, W] or None.
        camera: of the images.
        T_camera_world: float64 [4, 4].
    """

    def __init__(
        self,
        depth: np.ndarray,
        camera: Camera,
        T_world_camera: np.ndarray,
        color: np.ndarray | None,
        labels: np.ndarray | None,
        limit: float,
    ) -> None:
        """Checks them; positions must be within `limit` metres of the origin.

        Raises:
            InputError: naming what was expected and what was found.
        """
        size = (camera.height, camera.width)
        self.camera = camera
        self.depth = _image("depth", depth, np.float32, size)
        self.color = None if color is None else _image("color", color, np.uint8, (*size, 3))
        self.labels = None if labels is None else _image("labels", labels, np.uint16, size)
        T = np.asarray(T_world_camera, float)
        if T.shape != (4, 4) or not np.isfinite(T).all():
            raise InputError(f"T_world_camera: expected a finite matrix [4, 4], found {T_world_camera}")
        R = T[:3, :3]
        if np.abs(R.T @ R - np.eye(3)).max() > PoseCheckTuning.max_error or np.linalg.det(R) < 0:
            raise InputError(f"T_world_camera: expected a rotation in the upper left, found {R.tolist()}")
        if np.abs(T[:3, 3]).max() > limit:
            raise InputError(f"T_world_camera: expected a position within {limit:g} m, found {T[:3, 3].tolist()}")
        self.T_camera_world = inverse(T)

    def structure(self) -> FusionInput:
        """For the core; valid as long as the view."""
        c, T = self.camera, self.T_camera_world
        pointers = [None if a is None else a.ctypes.data for a in (self.depth, self.color, self.labels)]
        return FusionInput(
            *pointers, c.width, c.height, c.fx, c.fy, c.cx, c.cy, tuple(T[:3, :3].ravel()), tuple(T[:3, 3])
        )


def _image(name: str, values: np.ndarray, dtype: type, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(values)
    integers = np.issubdtype(dtype, np.integer)
    if array.shape != shape or (array.dtype != dtype if integers else array.dtype.kind != "f"):
        raise InputError(
            f"{name}: expected {np.dtype(dtype).name} {list(shape)}, found {array.dtype} {list(array.shape)}"
        )
    return np.ascontiguousarray(array, dtype)
