# SPDX-License-Identifier: Apache-2.0
"""Registering the images of a depth camera to another camera beside it: every depth pixel is moved in space and drawn
as a small square, the nearest surface wins."""

from __future__ import annotations

import math

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.sequences.recording import DepthCamera
from ggslam.system.tuning import Tuning


class RegistrationTuning(Tuning):
    """How depth is brought to another camera."""

    splat = 1.4
    """Side of the square that a depth pixel covers, in depth pixels: more than 1, so that surfaces have no pinholes."""


class DepthRegistration:
    """Turns depth images of one camera into depth images of another.

    Args:
        source: the depth camera; its intrinsics are brought to the size of the images.
        size: (width, height) of its images.
        target: pinhole camera of the images that come out.
    """

    def __init__(self, source: DepthCamera, size: tuple[int, int], target: Camera) -> None:
        camera = source.camera.resize(*size)
        rays = undistorted_rays(camera, source.distortion, source.fisheye)
        rotation, self._offset = source.T_color_depth[:3, :3], source.T_color_depth[:3, 3].astype(np.float32)
        # Coordinate by coordinate: arrays of points are several times slower to work on.
        self._rays = np.ascontiguousarray((rays.reshape(-1, 3) @ rotation.T).T.astype(np.float32))
        self._target = target
        self._side = (
            RegistrationTuning.splat * max(1.0, target.fx / camera.fx),
            RegistrationTuning.splat * max(1.0, target.fy / camera.fy),
        )

    def __call__(self, depth: np.ndarray) -> np.ndarray:
        """Depth float32 [H, W] of the depth camera, 0 = none -> float32 of the target camera, metres."""
        t, known = self._target, depth.reshape(-1)
        x, y, z = (ray * known + offset for ray, offset in zip(self._rays, self._offset, strict=True))
        usable = np.flatnonzero((known > 0) & (z > 1e-3))
        # Far ones first: where several fall on a pixel, the one assigned last stays. Integers sort quickest.
        millimetres = np.minimum(z[usable] * 1000, 65535).astype(np.uint16)
        order = usable[np.argsort(65535 - millimetres, kind="stable")]
        x, y, z = x[order], y[order], z[order]
        columns = _cells_covered(t.fx * x / z + t.cx, self._side[0], t.width)
        rows = _cells_covered(t.fy * y / z + t.cy, self._side[1], t.height)
        far = np.float32(1e9)
        image = np.full(t.height * t.width, far, np.float32)
        for row, hit_row in rows:
            for column, hit_column in columns:
                hit = np.flatnonzero(hit_row & hit_column)
                layer = np.full_like(image, far)
                layer[row[hit] * t.width + column[hit]] = z[hit]
                np.minimum(image, layer, out=image)
        image[image == far] = 0
        return image.reshape(t.height, t.width)


def _cells_covered(centre: np.ndarray, side: float, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rows (or columns) within `side` / 2 of `centre`: the first, the second, ..., and whether each is one."""
    first = np.ceil(np.clip(centre, -2 * side, count + side) - side / 2)
    found = []
    for step in range(math.ceil(side)):
        at = (first + step).astype(np.int32)
        found.append((at, (at >= 0) & (at < count) & (np.abs(at - centre) <= side / 2)))
    return found


def undistorted_rays(camera: Camera, distortion: np.ndarray | None, fisheye: bool) -> np.ndarray:
    """Viewing rays with z = 1 through the pixel centres of a camera with a distorting lens, float32 [H, W, 3]."""
    if distortion is None or not np.any(distortion):
        return camera.rays()
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    undistort = cv2.fisheye.undistortPoints if fisheye else cv2.undistortPoints
    plane = undistort(pixels, camera.matrix(), np.asarray(distortion, float)).reshape(camera.height, camera.width, 2)
    rays = np.ones((camera.height, camera.width, 3), np.float32)
    rays[..., :2] = plane
    return rays
