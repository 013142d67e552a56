# SPDX-License-Identifier: Apache-2.0
"""The latest located frames, kept to be searched once something starts to move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ggslam.movers.patches import Patch, patch_of
from ggslam.scene.frame import Frame


@dataclass
class RecentFrame:
    """A located frame as the movers saw it.

    Attributes:
        frame: what it holds is not copied.
        T_world_camera: float64 [4, 4].
        margin: metres by which depths of one surface differ there, by depth.
    """

    frame: Frame
    T_world_camera: np.ndarray
    margin: Callable[[np.ndarray], np.ndarray]
    _segments: np.ndarray | None = None

    def segments(self) -> np.ndarray | None:
        """The recording's masks, uint16 [H, W], read once."""
        if self._segments is None:
            self._segments = self.frame.load_mask()
        return self._segments

    def show(self, mask: np.ndarray) -> Sight | None:
        """What is on a mask bool [H, W]; None: too little."""
        patch = patch_of(mask, self.frame.depth, self.frame.color, self.frame.camera)
        if patch is None:
            return None
        z = float(np.median(patch.points[:, 2]))
        area = float(mask.sum()) * z * z / (self.frame.camera.fx * self.frame.camera.fy)
        margin = float(self.margin(np.float32(z)))
        return Sight(patch.move(self.T_world_camera), area, margin, float(mask.mean()))

    def show_surface(self, points: np.ndarray) -> np.ndarray:
        """Where points of a surface [n, 3], world, would be seen and something is that far: bool [H, W]."""
        found = np.zeros(self.frame.depth.shape, bool)
        rows, columns, z = self.project(points)
        there = np.abs(self.frame.depth[rows, columns] - z) < 2 * self.margin(z.astype(np.float32)) + 0.005
        found[rows[there], columns[there]] = True
        return found

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows, columns and depths of those of some points [n, 3], world, that fall into the image."""
        R, t = self.T_world_camera[:3, :3], self.T_world_camera[:3, 3]
        seen = (points - t) @ R
        rows, columns, inside = self.frame.camera.project(seen, nearest=0.05)
        return rows[inside], columns[inside], seen[inside, 2]


@dataclass(frozen=True)
class Sight:
    """What a frame shows of a mover.

    Attributes:
        patch: world.
        area: square metres facing the camera, about.
        margin: metres up to which points lie on a surface.
        share: of the image.
    """

    patch: Patch
    area: float
    margin: float
    share: float
