# SPDX-License-Identifier: Apache-2.0
"""Registering the images of a depth camera to another camera beside it: every depth pixel is moved in space and drawn
as a small square, the nearest surface wins."""

from __future__ import annotations

import math

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.sequences.recording import DepthCamera

SPLAT = 1.4
"""Side of the square that a depth pixel covers, in depth pixels: more than one, so that surfaces seen a little nearer
or turned towards the other camera have no pinholes."""


class DepthRegistration:
    """Turns depth images of one camera into depth images of another.

    Args:
        source: the depth camera; its intrinsics are brought to the size of the images.
        size: (width, height) of its images.
        target: pinhole camera of the images that come out.
    """

    def __init__(self, source: DepthCamera, size: tuple[int, int], target: Camera) -> None:
        camera = source.camera.resized(*size)
        rays = undistorted_rays(camera, source.distortion, source.fisheye)
        rotation, self._offset = source.T_color_depth[:3, :3], source.T_color_depth[:3, 3].astype(np.float32)
        self._rays = (rays.reshape(-1, 3) @ rotation.T).astype(np.float32)
        self._target = target
        self._side = (SPLAT * max(1.0, target.fx / camera.fx), SPLAT * max(1.0, target.fy / camera.fy))

    def __call__(self, depth: np.ndarray) -> np.ndarray:
        """Depth float32 [H, W] of the depth camera, 0 = none -> float32 of the target camera, metres."""
        t = self._target
        far = np.float32(1e9)
        image = np.full(t.height * t.width, far, np.float32)
        z = depth.reshape(-1)
        known = np.flatnonzero(z > 0)
        points = self._rays[known] * z[known, None] + self._offset
        points = points[points[:, 2] > 1e-3]
        u, v, z = t.fx * points[:, 0] / points[:, 2] + t.cx, t.fy * points[:, 1] / points[:, 2] + t.cy, points[:, 2]
        near = (u > -2) & (v > -2) & (u < t.width + 1) & (v < t.height + 1)
        u, v, z = u[near], v[near], z[near]
        half_u, half_v = self._side[0] / 2, self._side[1] / 2
        first_u, first_v = np.ceil(u - half_u).astype(np.int32), np.ceil(v - half_v).astype(np.int32)
        for dv in range(math.ceil(self._side[1])):
            for du in range(math.ceil(self._side[0])):
                column, row = first_u + du, first_v + dv
                hit = (column <= u + half_u) & (row <= v + half_v)
                hit &= (column >= 0) & (row >= 0) & (column < t.width) & (row < t.height)
                np.minimum.at(image, row[hit] * t.width + column[hit], z[hit])
        image[image == far] = 0
        return image.reshape(t.height, t.width)


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
