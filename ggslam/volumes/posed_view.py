# SPDX-License-Identifier: Apache-2.0
"""Images to fuse, and where they were seen from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import transform_points


@dataclass(frozen=True)
class PosedView:
    """What a camera sees of a surface.

    Attributes:
        depth: float32 [H, W], metres; 0: none; +inf: the sensor found nothing.
        camera: of the images.
        T_world_camera: float64 [4, 4].
        color: uint8 [H, W, 3], or None.
        labels: uint16 [H, W], object ids, or None.
    """

    depth: np.ndarray
    camera: Camera
    T_world_camera: np.ndarray
    color: np.ndarray | None = None
    labels: np.ndarray | None = None

    @property
    def point_count(self) -> int:
        """Number of its pixels with depth."""
        return int(np.count_nonzero((self.depth > 0) & (self.depth < np.inf)))

    def points(self) -> np.ndarray:
        """Where its pixels with depth lie, float64 [n, 3], world frame."""
        seen = self.camera.back_project(self.depth)[(self.depth > 0) & np.isfinite(self.depth)]
        return transform_points(seen.astype(np.float64), self.T_world_camera)
