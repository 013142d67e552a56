# SPDX-License-Identifier: Apache-2.0
"""Cameras that are fixed to one another and move as one body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse


@dataclass(frozen=True, eq=False)
class Rig:
    """A rig. Its own frame is that of its first camera.

    Attributes:
        names: of the cameras.
        cameras: their intrinsics.
        T_first_camera: float64 [n, 4, 4], from each camera's frame to the first one's; the first is the identity.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    T_first_camera: np.ndarray

    def __len__(self) -> int:
        return len(self.names)

    def pose_of_first(self, T_world_camera: np.ndarray, number: int) -> np.ndarray:
        """T_world_first [..., 4, 4] by the pose of camera `number`."""
        return T_world_camera @ inverse(self.T_first_camera[number])
