# SPDX-License-Identifier: Apache-2.0
"""Images and points for photometric alignment.

Where geometry leaves a direction of motion open (a bare wall, a floor), the texture on it does not. The grey values of
a frame's points are compared with a reference image, a keyframe's or a rendered one, at reduced resolution.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import cv2
import numpy as np

from ggslam.abi import core as structures
from ggslam.abi.arrays import address
from ggslam.scene.camera import Camera
from ggslam.scene.origin import moved_pose
from ggslam.scene.poses import inverse
from ggslam.tracking.settings import PhotometricSettings


def reduced_camera(camera: Camera, shrink: int) -> Camera:
    """The intrinsics of images `shrink` times smaller (rows and columns left over are cut)."""
    return Camera(
        camera.width // shrink, camera.height // shrink, camera.fx / shrink, camera.fy / shrink,
        (camera.cx + 0.5) / shrink - 0.5, (camera.cy + 0.5) / shrink - 0.5,
    )  # fmt: skip


@dataclass(frozen=True)
class GreyDepth:
    """A frame at reduced resolution.

    Attributes:
        grey: float32 [h, w] in [0, 1].
        depth: float32 [h, w], metres, 0 where unknown or across an edge.
        camera: its intrinsics.
    """

    grey: np.ndarray
    depth: np.ndarray
    camera: Camera

    @classmethod
    def from_images(cls, color: np.ndarray, depth: np.ndarray, camera: Camera, shrink: int) -> GreyDepth:
        """From colour uint8 [H, W, 3] and depth float32 [H, W], `shrink` times smaller (rows left over are cut)."""
        smaller = reduced_camera(camera, shrink)
        h, w = smaller.height, smaller.width
        grey = cv2.cvtColor(color[: h * shrink, : w * shrink], cv2.COLOR_RGB2GRAY)
        grey = cv2.resize(grey, (w, h), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        nearest = _over_cells(np.minimum, depth, (h, w), shrink)  # 0 if any is unknown
        furthest = _over_cells(np.maximum, depth, (h, w), shrink)
        return cls(grey, np.where(furthest < nearest * 1.03, nearest, np.float32(0)), smaller)


def _over_cells(choose: np.ufunc, depth: np.ndarray, shape: tuple[int, int], shrink: int) -> np.ndarray:
    """`choose` over cells of `shrink` x `shrink` pixels, [h, w]: first over rows, which lie together in memory."""
    h, w = shape
    rows = reduce(choose, (depth[r : h * shrink : shrink, : w * shrink] for r in range(shrink)))
    return reduce(choose, (rows[:, c::shrink] for c in range(shrink)))


@dataclass(frozen=True)
class PhotometricReference:
    """An image to compare with.

    Attributes:
        pixels: float32 [h, w, 4]: grey, its derivatives by column and row (per pixel), depth in metres (0: unknown, no
            test for occlusion).
        camera: its intrinsics.
        T_world_camera: float64 [4, 4].
    """

    pixels: np.ndarray
    camera: Camera
    T_world_camera: np.ndarray

    @classmethod
    def from_view(cls, view: GreyDepth, T_world_camera: np.ndarray) -> PhotometricReference:
        """From a view, smoothed a little so that the derivatives hold for more than half a pixel."""
        grey = cv2.GaussianBlur(view.grey, (3, 3), 0.7)
        du = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
        dv = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
        return cls(np.ascontiguousarray(np.dstack([grey, du, dv, view.depth])), view.camera, T_world_camera.copy())

    def native(self, origin: np.ndarray | None = None) -> structures.PhotometricReferenceView:
        """The core's form, in a world whose origin is at `origin` [3]; this object must stay alive."""
        T = inverse(self.T_world_camera if origin is None else moved_pose(self.T_world_camera, -origin))
        view = structures.PhotometricReferenceView(
            address(self.pixels), self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy,
            self.camera.width, self.camera.height,
        )  # fmt: skip
        view.rotation[:] = T[:3, :3].ravel().tolist()
        view.translation[:] = T[:3, 3].tolist()
        return view


@dataclass(frozen=True)
class PhotometricPoints:
    """Points of a frame with texture.

    Attributes:
        points: float32 [n, 3], camera frame, metres.
        intensity: float32 [n], grey in [0, 1].
    """

    points: np.ndarray
    intensity: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    def native(self) -> structures.PhotometricPoints:
        """The core's form; this object must stay alive."""
        return structures.PhotometricPoints(address(self.points), address(self.intensity), len(self))


def textured_points(view: GreyDepth, settings: PhotometricSettings) -> PhotometricPoints:
    """The pixels of a view with depth and enough contrast, evenly thinned to the number set."""
    grey = cv2.GaussianBlur(view.grey, (3, 3), 0.7)
    du = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    dv = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    chosen = np.flatnonzero((view.depth > 0) & (du * du + dv * dv > settings.min_gradient**2))
    if len(chosen) > settings.points:
        chosen = chosen[np.linspace(0, len(chosen) - 1, settings.points).astype(np.int64)]
    v, u = np.divmod(chosen, view.camera.width)
    z = view.depth.ravel()[chosen]
    camera = view.camera
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)
    return PhotometricPoints(np.ascontiguousarray(points, np.float32), np.ascontiguousarray(grey.ravel()[chosen]))
