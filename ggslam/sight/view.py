# SPDX-License-Identifier: Apache-2.0
"""What a located depth image says about a place in the world: it looks through it, shows it, or something hides it.

    view = View.of(depth, camera, T_world_camera, Margin.of(noise), context)
    answers = view.classify_points(points)
    gone = answers.through          # or answers.codes == Sight.THROUGH

Depth changes within a pixel at outlines, and poses err by a pixel there. So a view surely looks through a place only if
everything that it shows about the place's pixel is farther away.
"""

from __future__ import annotations

import ctypes
import threading
from dataclasses import dataclass, replace
from enum import IntEnum

import cv2
import numpy as np

from ggslam.abi.arrays import address
from ggslam.abi.core import SightCode, SightJob
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, transform_points
from ggslam.sight.margin import Margin
from ggslam.system.array_forms import DepthImage, Pose

_ABOUT = np.ones((3, 3), np.uint8)
"""A pixel and those about it."""


class Sight(IntEnum):
    """What a view says of a place; from THROUGH on in the order in which places lie along a ray."""

    OUTSIDE = SightCode.OUTSIDE
    """Nothing: the place is behind the camera or beside its image."""
    UNKNOWN = SightCode.UNKNOWN
    """Nothing: the pixel it falls on has no depth."""
    THROUGH = SightCode.THROUGH
    """The view looks through it: everything about its pixel is known, and farther away."""
    BEFORE = SightCode.BEFORE
    """It is before what its pixel shows, but beside an outline or a hole: perhaps the view looks through it."""
    SAME = SightCode.SAME
    """It is on the surface that its pixel shows."""
    BEHIND = SightCode.BEHIND
    """It is behind what its pixel shows, but beside an outline or a hole."""
    HIDDEN = SightCode.HIDDEN
    """Everything about its pixel is known, and nearer."""


_LOCAL = threading.local()


def _single_thread() -> NativeContext:
    """The calling thread's own context, without further threads."""
    if not hasattr(_LOCAL, "context"):
        _LOCAL.context = NativeContext(1)
    context: NativeContext = _LOCAL.context
    return context


@dataclass(frozen=True)
class Answers:
    """What a view says of each of n places.

    Attributes:
        codes: uint8 [n], a `Sight` each.
        pixels: int32 [n], row * width + column of the pixel that each falls on; 0 outside.
        z: float64 [n], depth in the camera's frame, metres.
    """

    codes: np.ndarray
    pixels: np.ndarray
    z: np.ndarray

    @property
    def inside(self) -> np.ndarray:
        """bool [n]: it falls into the image."""
        return self.codes != Sight.OUTSIDE

    @property
    def through(self) -> np.ndarray:
        """bool [n]: the view surely looks through it."""
        return self.codes == Sight.THROUGH

    @property
    def before(self) -> np.ndarray:
        """bool [n]: it is before what its pixel shows, surely looked through or not."""
        return (self.codes == Sight.THROUGH) | (self.codes == Sight.BEFORE)

    @property
    def same(self) -> np.ndarray:
        """bool [n]: it is on the surface that its pixel shows."""
        return self.codes == Sight.SAME

    @property
    def behind(self) -> np.ndarray:
        """bool [n]: what its pixel shows is before it."""
        return self.codes >= Sight.BEHIND

    def at(self, image: np.ndarray) -> np.ndarray:
        """The values of an image [H, W, ...] at the pixels of the places, [n, ...]; that of pixel 0 outside."""
        return image.reshape(-1, *image.shape[2:])[self.pixels]


@dataclass(frozen=True)
class View:
    """A depth image and its pose.

    Attributes:
        depth: float32 [H, W], metres, 0 where unknown.
        near, far: float32 [H, W], least and greatest depth of each pixel and those about it; `near` is 0 where one of
            them is unknown.
        camera: of the image.
        T_world_camera: float64 [4, 4].
        margin: how far depths of one surface may differ.
        context: threads.
    """

    depth: DepthImage
    near: DepthImage
    far: DepthImage
    camera: Camera
    T_world_camera: Pose
    margin: Margin
    context: NativeContext

    @staticmethod
    def of(
        depth: np.ndarray, camera: Camera, T_world_camera: np.ndarray, margin: Margin,
        context: NativeContext | None = None, whole_only: bool = False,
    ) -> View:  # fmt: skip
        """A view of a depth image [H, W].

        Args:
            depth, camera, T_world_camera, margin: see the attributes.
            context: threads; None: the calling one alone.
            whole_only: say nothing at pixels beside unknown ones.

        Raises:
            ValueError: the image is not of the camera's size.
        """
        if depth.shape != (camera.height, camera.width):
            raise ValueError(f"view: expected depth {camera.height} x {camera.width}, found {depth.shape}")
        depth = np.ascontiguousarray(depth, np.float32)
        near, far = cv2.erode(depth, _ABOUT), cv2.dilate(depth, _ABOUT)
        if whole_only:
            depth = np.where(near > 0, depth, np.float32(0))
        return View(depth, near, far, camera, np.array(T_world_camera, np.float64), margin, context or _single_thread())

    def move(self, T_new_old: np.ndarray) -> View:
        """The view after the world about it was moved by [4, 4], as a closed loop does."""
        return replace(self, T_world_camera=T_new_old @ self.T_world_camera)

    def points(self) -> np.ndarray:
        """World points, float64 [H W, 3], of its pixels; those without depth are at its camera."""
        return transform_points(self.camera.back_project(self.depth).reshape(-1, 3).astype(float), self.T_world_camera)

    def classify_points(self, points: np.ndarray) -> Answers:
        """What the view says of world points [n, 3]."""
        return self._ask(len(points), points=np.ascontiguousarray(points, np.float64).reshape(-1, 3))

    def classify_depth(self, depth: np.ndarray) -> np.ndarray:
        """What the view says of places along its own rays, at depths [H, W] in metres (0: none): codes uint8 [H, W].

        Raises:
            ValueError: the image is not of the view's size.
        """
        if depth.shape != self.depth.shape:
            raise ValueError(f"view: expected depths {self.depth.shape}, found {depth.shape}")
        return self._ask(depth.size, depths=np.ascontiguousarray(depth, np.float32)).codes.reshape(depth.shape)

    def classify_view(self, other: View) -> np.ndarray:
        """What the view says of the surfaces that another one shows: codes uint8 [h, w] of the other's pixels; OUTSIDE
        where that one shows none."""
        codes = self.classify_points(other.points()).codes.reshape(other.depth.shape)
        return np.where(other.depth > 0, codes, np.uint8(Sight.OUTSIDE))

    def _ask(self, count: int, points: np.ndarray | None = None, depths: np.ndarray | None = None) -> Answers:
        camera = self.camera
        found = Answers(np.empty(count, np.uint8), np.empty(count, np.int32), np.empty(count))
        job = SightJob(
            *map(address, (self.depth, self.near, self.far)), camera.height, camera.width,
            camera.fx, camera.fy, camera.cx, camera.cy,
        )  # fmt: skip
        job.T_camera_world[:] = inverse(self.T_world_camera)[:3].ravel().tolist()
        job.margin = self.margin.native()
        job.points, job.depths, job.count = address(points), address(depths), count
        job.codes, job.pixels, job.z = address(found.codes), address(found.pixels), address(found.z)
        load_library().ggslam_sight(self.context.handle, ctypes.byref(job))
        return found
