# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ggslam.errors import InputError
from ggslam.system.savable import savable


@savable(checked=True)
@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion.

    Pixel convention of OpenCV: the centre of the top-left pixel is (0, 0), so a point (x, y, z) in the camera frame
    falls on column u = fx x / z + cx and row v = fy y / z + cy. (3DGS renderers put that centre at (0.5, 0.5); the
    rendering backends convert.)

    Attributes:
        width, height: image size in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        """Raises InputError for a size below 1, a focal length that is not positive, or numbers that are not finite."""
        numbers = (self.fx, self.fy, self.cx, self.cy)
        if self.width < 1 or self.height < 1 or not all(map(math.isfinite, numbers)) or self.fx <= 0 or self.fy <= 0:
            raise InputError(f"impossible camera: {self}")

    def resize(self, width: int, height: int) -> Camera:
        """The camera of the same view with its image resampled to `width` x `height` pixels."""
        sx, sy = width / self.width, height / self.height
        return Camera(
            width, height, self.fx * sx, self.fy * sy, (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        )

    def scale(self, factor: float) -> Camera:
        """The camera with its image size multiplied by `factor` (rounded to whole pixels)."""
        return self.resize(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def matrix(self) -> np.ndarray:
        """The 3x3 calibration matrix K, float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def rays(self) -> np.ndarray:
        """Viewing rays with z = 1 through the pixel centres, float32 [H, W, 3], read-only."""
        return _rays(self)

    def back_project(self, depth: np.ndarray) -> np.ndarray:
        """Points in the camera frame, float32 [H, W, 3], of a depth image [H, W] in metres (0 stays the origin)."""
        return self.rays() * depth[..., None].astype(np.float32)

    def project(self, points: np.ndarray, nearest: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The pixels that points [n, 3] in the camera frame fall on: rows and columns, int64 [n], 0 outside, and
        whether they fall into the image, farther away than `nearest` metres, bool [n]."""
        z = np.maximum(points[:, 2], 1e-6)
        column, row = np.rint(self.fx * points[:, 0] / z + self.cx), np.rint(self.fy * points[:, 1] / z + self.cy)
        inside = (points[:, 2] > nearest) & (row >= 0) & (column >= 0) & (row < self.height) & (column < self.width)
        return np.where(inside, row, 0).astype(np.int64), np.where(inside, column, 0).astype(np.int64), inside


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> np.ndarray:
    u = (np.arange(camera.width, dtype=np.float32) - camera.cx) / camera.fx
    v = (np.arange(camera.height, dtype=np.float32) - camera.cy) / camera.fy
    rays = np.ones((camera.height, camera.width, 3), np.float32)
    rays[..., 0], rays[..., 1] = u[None, :], v[:, None]
    rays.setflags(write=False)
    return rays
