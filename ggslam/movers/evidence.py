# SPDX-License-Identifier: Apache-2.0
"""What a frame's depth says against that of frames before it: where they looked through what it sees now, and where it
looks through what they saw.

Both compare coarse images, and with the nearest (or the farthest) depth around each place, so that neither outlines nor
the last millimetre of a pose are taken for something that moved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, transform_points

Margin = Callable[[np.ndarray], np.ndarray]
"""Depths in metres -> what depths of one surface may differ by there, metres."""
_NO_DEPTH = np.float32(np.inf)


@dataclass(frozen=True)
class CoarseView:
    """A located depth image, `factor` times smaller.

    Attributes:
        camera: of the small image.
        T_world_camera: float64 [4, 4].
        depth: float32 [h, w], metres, 0 where unknown.
        near: the nearest depth in the 3x3 places about each, infinite where nothing is known...
        far: ...and the farthest, infinite where not all of them are known.
    """

    camera: Camera
    T_world_camera: np.ndarray
    depth: np.ndarray
    near: np.ndarray
    far: np.ndarray

    @staticmethod
    def of(depth: np.ndarray, camera: Camera, factor: int, T_world_camera: np.ndarray) -> CoarseView:
        """Of a depth image float32 [H, W]; rows and columns left over are cut."""
        h, w = camera.height // factor, camera.width // factor
        middle = (factor - 1) / 2
        small = Camera(
            w, h, camera.fx / factor, camera.fy / factor, (camera.cx - middle) / factor, (camera.cy - middle) / factor
        )
        around = np.ones((3 * factor, 3 * factor), np.uint8)
        known = np.where(depth > 0, depth, _NO_DEPTH)
        near, far = (thin_out(image, factor) for image in (cv2.erode(known, around), cv2.dilate(known, around)))
        for edge in (far[0], far[-1], far[:, 0], far[:, -1]):  # what is about it is not in the image
            edge[:] = _NO_DEPTH
        return CoarseView(small, np.array(T_world_camera, float), thin_out(depth, factor), near, far)

    def move(self, T_new_old: np.ndarray) -> CoarseView:
        """The same after the world about it was moved by [4, 4]."""
        return CoarseView(self.camera, T_new_old @ self.T_world_camera, self.depth, self.near, self.far)


def thin_out(image: np.ndarray, factor: int) -> np.ndarray:
    """The middle pixel of each `factor` x `factor` pixels of an image [H, W]; rows and columns left over are cut."""
    rows, columns = (side // factor * factor for side in image.shape[:2])
    return np.ascontiguousarray(image[factor // 2 : rows : factor, factor // 2 : columns : factor])


@dataclass(frozen=True)
class PairEvidence:
    """What another view says of each place of a view, bool [h, w] each.

    Attributes:
        passed: the other view looked past it, at something farther...
        clearly: ...by twice the margin.
        same: the other view saw a surface there.
    """

    passed: np.ndarray
    clearly: np.ndarray
    same: np.ndarray


def compare(view: CoarseView, other: CoarseView, margin: Margin) -> PairEvidence:
    """What `other` says of what `view` sees."""
    camera = other.camera
    T_other_view = (inverse(other.T_world_camera) @ view.T_world_camera).astype(np.float32)
    points = transform_points(view.camera.back_project(view.depth).reshape(-1, 3), T_other_view)
    z = points[:, 2]
    ahead = np.maximum(z, np.float32(1e-3))
    u = (np.float32(camera.fx) * points[:, 0] / ahead + np.float32(camera.cx + 0.5)).astype(np.int32)
    v = (np.float32(camera.fy) * points[:, 1] / ahead + np.float32(camera.cy + 0.5)).astype(np.int32)
    inside = (view.depth.reshape(-1) > 0) & (z > 1e-3) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    where = np.where(inside, v * camera.width + u, 0)
    near, far, slack = other.near.reshape(-1)[where], other.far.reshape(-1)[where], margin(z)
    known = inside & np.isfinite(far)
    passed, clearly = known & (near > z + slack), known & (near > z + 2 * slack)
    same = known & (near < z + slack) & (far > z - slack)
    return PairEvidence(*(found.reshape(view.depth.shape) for found in (passed, clearly, same)))
