# SPDX-License-Identifier: Apache-2.0
"""Cameras that are no pinholes: lenses that distort, and parallel projection."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np

from ggslam.errors import InputError
from ggslam.scene.camera import Camera

COUNTS: Final = (4, 5, 8, 12, 14)
"""Numbers of coefficients of OpenCV's model: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [two tilts]]]]."""
_NEWTON_STEPS: Final = 8


@dataclass(frozen=True)
class DistortedCamera:
    """A camera whose lens distorts, in OpenCV's models.

    Attributes:
        pinhole: size, focal lengths and principal point of its images, in pixels.
        distortion: coefficients. Of a fisheye (Kannala-Brandt) lens k1 k2 k3 k4; else 4, 5, 8, 12 or 14 of
            Brown-Conrady's: k1 k2 p1 p2 [k3 [k4 k5 k6 ...]].
        fisheye: which of the two it is.

    Raises:
        InputError: another number of coefficients, or some that are not finite.
    """

    pinhole: Camera
    distortion: tuple[float, ...]
    fisheye: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", tuple(float(k) for k in self.distortion))
        counts = (4,) if self.fisheye else COUNTS
        if len(self.distortion) not in counts or not all(map(math.isfinite, self.distortion)):
            wanted = " or ".join(map(str, counts))
            raise InputError(f"distortion: expected {wanted} finite coefficients, found {list(self.distortion)}")

    @property
    def width(self) -> int:
        """Pixels."""
        return self.pinhole.width

    @property
    def height(self) -> int:
        """Pixels."""
        return self.pinhole.height

    def rays(self) -> np.ndarray:
        """Unit viewing rays through the pixel centres in the camera frame, float64 [H, W, 3], read-only; NaN where the
        lens sees nothing, because no direction falls on the pixel."""
        return _rays(self)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels float64 [n, 2], column and row, that points [n, 3] in the camera frame fall on.

        With a fisheye lens also points beside and behind the camera do; else those with z > 0.
        """
        points = np.asarray(points, np.float64).reshape(-1, 3)
        if not self.fisheye:
            zero = np.zeros(3)
            lens = self.pinhole.matrix(), np.array(self.distortion)
            return cv2.projectPoints(points[:, None], zero, zero, *lens)[0][:, 0]
        across = np.linalg.norm(points[:, :2], axis=1)
        bent = _bend(np.arctan2(across, points[:, 2]), self.distortion)
        scale = np.divide(bent, across, out=np.zeros_like(across), where=across > 1e-12)
        c = self.pinhole
        return np.stack([c.fx * points[:, 0] * scale + c.cx, c.fy * points[:, 1] * scale + c.cy], 1)


@dataclass(frozen=True)
class OrthographicCamera:
    """A camera of parallel rays along z: a point (x, y, z) falls on column scale x + cx and row scale y + cy.

    Attributes:
        width, height: image size in pixels.
        scale: pixels per metre.
        cx, cy: where the camera's z axis meets the image, in pixels.

    Raises:
        InputError: a size below 1, a scale that is not positive, or numbers that are not finite.
    """

    width: int
    height: int
    scale: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        finite = all(map(math.isfinite, (self.scale, self.cx, self.cy)))
        if self.width < 1 or self.height < 1 or not finite or self.scale <= 0:
            raise InputError(f"impossible camera: {self}")

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels float64 [n, 2], column and row, that points [n, 3] in the camera frame fall on."""
        return self.scale * np.asarray(points, np.float64)[:, :2] + (self.cx, self.cy)


def _bend(angle: np.ndarray, k: tuple[float, ...]) -> np.ndarray:
    """Kannala and Brandt's distorted angle of the angle to the axis, radians."""
    square = angle**2
    return angle * (1 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3]))))


def _bend_slope(angle: np.ndarray, k: tuple[float, ...]) -> np.ndarray:
    square = angle**2
    return 1 + square * (3 * k[0] + square * (5 * k[1] + square * (7 * k[2] + square * 9 * k[3])))


@lru_cache(maxsize=4)
def _rays(camera: DistortedCamera) -> np.ndarray:
    c = camera.pinhole
    row, column = np.mgrid[: c.height, : c.width].astype(np.float64)
    x, y = (column - c.cx) / c.fx, (row - c.cy) / c.fy
    rays = _fisheye_rays(x, y, camera.distortion) if camera.fisheye else _brown_rays(x, y, camera)
    rays.setflags(write=False)
    return rays


def _fisheye_rays(x: np.ndarray, y: np.ndarray, k: tuple[float, ...]) -> np.ndarray:
    """By bisection, which finds the angle wherever the lens's curve rises from the axis on."""
    bent = np.hypot(x, y)
    samples = np.linspace(0, np.pi, 4097)
    falls = np.flatnonzero(_bend_slope(samples, k) <= 0)
    end = samples[falls[0] - 1] if len(falls) else np.pi
    low, high = np.zeros_like(bent), np.full_like(bent, end)
    for _ in range(54):
        middle = (low + high) / 2
        above = _bend(middle, k) > bent
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    angle = (low + high) / 2
    scale = np.divide(np.sin(angle), bent, out=np.ones_like(bent), where=bent > 1e-12)
    rays = np.stack([x * scale, y * scale, np.cos(angle)], -1)
    rays[bent > _bend(np.array(end), k) + 1e-9] = np.nan
    return rays


def _brown_rays(x: np.ndarray, y: np.ndarray, camera: DistortedCamera) -> np.ndarray:
    """By Newton's method from OpenCV's first guess; where the lens does not lead back, nothing is seen."""
    c = camera.pinhole
    pixels = np.stack([x * c.fx + c.cx, y * c.fy + c.cy], -1).reshape(-1, 2)
    plane = cv2.undistortPoints(pixels[:, None], c.matrix(), np.array(camera.distortion))[:, 0]
    rays = np.concatenate([plane, np.ones((len(plane), 1))], 1)
    step = 1e-6
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            slopes = [(camera.project(rays + step * axis) - camera.project(rays - step * axis)) / (2 * step)
                      for axis in np.eye(3)[:2]]  # fmt: skip
            (a, d), (b, e) = (slope.T for slope in slopes)  # columns of the Jacobian [a b; d e]
            wrong, area = pixels - camera.project(rays), a * e - b * d
            rays[:, 0] += (e * wrong[:, 0] - b * wrong[:, 1]) / area
            rays[:, 1] += (a * wrong[:, 1] - d * wrong[:, 0]) / area
        found = (np.abs(pixels - camera.project(rays)).max(1) < 1e-6 * c.fx) & (area > 0)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays[~found] = np.nan
    return rays.reshape(*x.shape, 3)
