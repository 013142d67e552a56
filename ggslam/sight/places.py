# SPDX-License-Identifier: Apache-2.0
"""Compares whole views at reduced size: where other views looked through what a view shows. Finds what moves and what
left since an earlier visit.

Views are compared with the nearest (or the farthest) depth around each place, so that neither outlines nor
the last millimetre of a pose are taken for something that moved. On smooth surfaces these are of means, whose noise is
small; how small is measured on what two views see alike, for noise that neighbouring pixels share, warped depth and
errors of poses do not average out.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.abi.arrays import address
from ggslam.abi.core import (
    DepthPlacesJob,
    OtherPlacesView,
    PlacesEvidenceJob,
    PlacesRule,
    PlacesView,
)
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.sight.margin import Margin
from ggslam.system.array_forms import DepthImage, Mask, Pose
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class PlaceTuning(Tuning):
    """Comparison of reduced views."""

    smooth_sigmas = 2.5
    """Largest spread of depth in a smooth place, in standard deviations of the camera. Its mean is compared."""
    min_known = 0.9
    """Smallest share of pixels with depth around a place whose mean is compared."""
    rough_sigmas = 1.3
    """Spread of the nearest depth in a rough place, in standard deviations of one pixel."""
    min_noise_share = 0.2
    """Smallest spread of the means of smooth places, as a share of the camera's standard deviation."""
    nearest_factor = 0.7
    """Spread of the nearest of several means, as a share of the spread measured there."""
    stride = 7
    """One smooth place in this many tells how much depths differ..."""
    min_places = 40
    """...if there are at least this many of them."""


@savable(fixed="depth near far whole smooth")
@dataclass(frozen=True)
class CoarseView:
    """A located depth image, `factor` times smaller.

    Attributes:
        camera: of the small image.
        T_world_camera: float64 [4, 4].
        depth: float32 [h, w], metres, 0 where unknown.
        near: the nearest depth in the 3x3 places about each, infinite where nothing is known...
        far: ...and the farthest, 0 there.
        whole: bool [h, w], where all of them are known.
        smooth: bool [h, w], where these are of means.
    """

    camera: Camera
    T_world_camera: Pose
    depth: DepthImage
    near: DepthImage
    far: DepthImage
    whole: Mask
    smooth: Mask

    def fits(self, *more: np.ndarray) -> bool:
        """Whether its images, and some more about its places, are of its camera's size."""
        images = (self.depth, self.near, self.far, self.whole, self.smooth, *more)
        return all(image.shape == (self.camera.height, self.camera.width) for image in images)

    @staticmethod
    def of(
        depth: np.ndarray, camera: Camera, factor: int, T_world_camera: np.ndarray, margin: Margin,
        context: NativeContext,
    ) -> CoarseView:  # fmt: skip
        """Of a depth image float32 [H, W]; rows and columns left over are cut."""
        around, window = np.ones((3, 3), np.uint8), window_of(factor)
        nearest, farthest, least, count, total, squares = _depth_places(depth, factor, window // 2, context)
        mean = total / np.maximum(count, 1)
        spread = squares / np.maximum(count, 1) - mean * mean
        smooth = (count >= PlaceTuning.min_known * window**2) & (
            spread < (PlaceTuning.smooth_sigmas * margin.sigma(mean)) ** 2
        )
        value = np.where(smooth, mean, thin_out(depth, factor))
        near, far = np.where(smooth, mean, nearest), np.where(smooth, mean, farthest)
        whole = cv2.erode(((least > 0) | smooth).astype(np.uint8), around) > 0
        whole[[0, -1]] = whole[:, [0, -1]] = False  # what is about them is not in the image
        near, far = cv2.erode(near, around), cv2.dilate(far, around)
        small, T_world_camera = small_camera(camera, factor), np.array(T_world_camera, float)
        return CoarseView(small, T_world_camera, value, near, far, whole, smooth)

    def move(self, T_new_old: np.ndarray) -> CoarseView:
        """The same after the world about it was moved by [4, 4]."""
        return CoarseView(
            self.camera, T_new_old @ self.T_world_camera, self.depth, self.near, self.far, self.whole, self.smooth
        )


def thin_out(image: np.ndarray, factor: int) -> np.ndarray:
    """The middle pixel of each `factor` x `factor` pixels of an image [H, W]; rows and columns left over are cut."""
    rows, columns = (side // factor * factor for side in image.shape[:2])
    return np.ascontiguousarray(image[factor // 2 : rows : factor, factor // 2 : columns : factor])


def small_camera(camera: Camera, factor: int) -> Camera:
    """The camera of an image's places; rows and columns left over are cut."""
    middle = (factor - 1) / 2
    return Camera(
        camera.width // factor, camera.height // factor, camera.fx / factor, camera.fy / factor,
        (camera.cx - middle) / factor, (camera.cy - middle) / factor,
    )  # fmt: skip


def window_of(factor: int) -> int:
    """Pixels across what is averaged: odd."""
    return 2 * round(5 / 6 * factor - 0.5) + 1


@dataclass(frozen=True)
class PairEvidence:
    """What another view says of each place of a view, bool [h, w] each.

    Attributes:
        passed: the other view looked past it, at something farther...
        clearly: ...by twice the margin...
        surely: ...and both of them saw something smooth.
        same: the other view saw a surface there...
        otherwise: ...or nothing but others.
    """

    passed: np.ndarray
    clearly: np.ndarray
    surely: np.ndarray
    same: np.ndarray
    otherwise: np.ndarray


def compare(
    view: CoarseView, others: Sequence[CoarseView], margin: Margin, context: NativeContext,
    moved: np.ndarray | None = None,
) -> list[PairEvidence]:  # fmt: skip
    """What each of `others` says of what `view` sees.

    Args:
        view: see there.
        others: see there.
        margin: see there.
        context: that it is computed in.
        moved: places of `view`, bool [h, w], that say nothing of how much depths of one surface differ.

    Raises:
        ValueError: an array has another shape than its view's camera.
    """
    alive: list[np.ndarray] = []
    asked = (OtherPlacesView * len(others))()
    for one, other in zip(asked, others, strict=True):
        one.places = native_places(other, alive)
        T = (inverse(other.T_world_camera) @ view.T_world_camera)[:3].astype(np.float32)
        one.T_this_view[:] = T.ravel().tolist()
    found = np.empty((len(others), 5, *view.depth.shape), bool)
    job = PlacesEvidenceJob(native_places(view, alive), ctypes.addressof(asked), len(others))
    if moved is not None:
        job.moved = address(_of_places(moved, np.uint8, view, alive))
    job.rule, job.found = native_rule(margin), address(found)
    load_library().ggslam_places_evidence(context.handle, ctypes.byref(job))
    return [PairEvidence(*images) for images in found]


def _depth_places(depth: np.ndarray, factor: int, reach: int, context: NativeContext) -> np.ndarray:
    """What `DepthPlacesJob` finds, float32 [6, h, w]."""
    depth = np.ascontiguousarray(depth, np.float32)
    height, width = depth.shape
    found = np.empty((6, height // factor, width // factor), np.float32)
    job = DepthPlacesJob(address(depth), height, width, factor, reach, *map(address, found))
    load_library().ggslam_depth_places(context.handle, ctypes.byref(job))
    return found


def native_rule(margin: Margin) -> PlacesRule:
    """How views are compared, as the core takes it."""
    t = PlaceTuning
    return PlacesRule(
        margin.native(), t.rough_sigmas, t.min_noise_share, t.nearest_factor, t.stride, t.min_places
    )  # fmt: skip


def native_places(view: CoarseView, alive: list[np.ndarray]) -> PlacesView:
    """A view as the core takes it; `alive` gets arrays that must outlive it.

    Raises:
        ValueError: an array has another shape than the view's camera.
    """
    camera = view.camera
    images = [_of_places(image, np.float32, view, alive) for image in (view.depth, view.near, view.far)]
    images += [_of_places(image, np.uint8, view, alive) for image in (view.whole, view.smooth)]
    return PlacesView(
        *map(address, images), camera.height, camera.width, camera.fx, camera.fy, camera.cx, camera.cy
    )  # fmt: skip


def _of_places(image: np.ndarray, wanted: type, view: CoarseView, alive: list[np.ndarray]) -> np.ndarray:
    if image.shape != (view.camera.height, view.camera.width):
        raise ValueError(f"places: expected {view.camera.height} x {view.camera.width} of them, found {image.shape}")
    alive.append(np.ascontiguousarray(image, wanted))
    return alive[-1]
