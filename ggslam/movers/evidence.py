# SPDX-License-Identifier: Apache-2.0
"""What a frame's depth says against that of frames before it: where they looked through what it sees now, and where it
looks through what they saw.

Both compare coarse images, and with the nearest (or the farthest) depth around each place, so that neither outlines nor
the last millimetre of a pose are taken for something that moved. On smooth surfaces these are of means, whose noise is
small; how small is measured on what two views see alike, for noise that neighbouring pixels share, warped depth and
errors of poses do not average out.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, transform_points

_NO_DEPTH = np.float32(np.inf)
SMOOTH = 2.5
"""Where depth varies by no more standard deviations of the camera than this its mean is compared."""
KNOWN = 0.9
"""Share of the pixels about a place that have depth where their mean is compared."""


ROUGH = 1.3
"""Standard deviations of a pixel's depth by which those of rough places differ: the nearest of several is compared."""
LEAST_SHARE = 0.2
"""...and means of smooth ones, at least..."""
NEAREST = 0.7
"""...and so many times what is measured there, for the nearest of them is compared too."""
EVERY = 7
"""Of so many smooth places one tells how much depths differ."""
FEWEST = 40
"""If there are so many of them."""


@dataclass(frozen=True)
class Margin:
    """What depths of one surface may differ by.

    Attributes:
        least: metres, whatever the noise: poses are no better.
        sigmas: standard deviations of the depth camera's noise...
        constant, square: ...which is constant + square z^2, metres.
    """

    least: float
    sigmas: float
    constant: float
    square: float = 0.0

    def __call__(self, z: np.ndarray, share: np.ndarray | float = 1.0) -> np.ndarray:
        """At depths in metres; `share`: of a pixel's noise that is left where a mean is compared."""
        return np.float32(self.least) + np.float32(self.sigmas) * share * self.sigma(z)

    def sigma(self, z: np.ndarray) -> np.ndarray:
        """Standard deviation of a pixel's depth, metres."""
        return np.float32(self.constant) + np.float32(self.square) * z * z


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
    T_world_camera: np.ndarray
    depth: np.ndarray
    near: np.ndarray
    far: np.ndarray
    whole: np.ndarray
    smooth: np.ndarray

    @staticmethod
    def of(depth: np.ndarray, camera: Camera, factor: int, T_world_camera: np.ndarray, margin: Margin) -> CoarseView:
        """Of a depth image float32 [H, W]; rows and columns left over are cut."""
        h, w = camera.height // factor, camera.width // factor
        middle = (factor - 1) / 2
        small = Camera(
            w, h, camera.fx / factor, camera.fy / factor, (camera.cx - middle) / factor, (camera.cy - middle) / factor
        )
        own, around = np.ones((factor, factor), np.uint8), np.ones((3, 3), np.uint8)
        window = _window(factor)
        near = thin_out(cv2.erode(np.where(depth > 0, depth, _NO_DEPTH), own), factor)
        far, least = thin_out(cv2.dilate(depth, own), factor), thin_out(cv2.erode(depth, own), factor)
        count, total, squares = (
            thin_out(cv2.boxFilter(image, -1, (window, window), normalize=False), factor)
            for image in ((depth > 0).astype(np.float32), depth, depth * depth)
        )
        mean = total / np.maximum(count, 1)
        spread = squares / np.maximum(count, 1) - mean * mean
        smooth = (count >= KNOWN * window**2) & (spread < (SMOOTH * margin.sigma(mean)) ** 2)
        exact = thin_out(depth, factor)
        value = np.where(smooth, mean, exact)
        near, far = np.where(smooth, mean, near), np.where(smooth, mean, far)
        whole = cv2.erode(((least > 0) | smooth).astype(np.uint8), around) > 0
        whole[[0, -1]] = whole[:, [0, -1]] = False  # what is about them is not in the image
        near, far = cv2.erode(near, around), cv2.dilate(far, around)
        return CoarseView(small, np.array(T_world_camera, float), value, near, far, whole, smooth)

    def move(self, T_new_old: np.ndarray) -> CoarseView:
        """The same after the world about it was moved by [4, 4]."""
        return CoarseView(
            self.camera, T_new_old @ self.T_world_camera, self.depth, self.near, self.far, self.whole, self.smooth
        )


def thin_out(image: np.ndarray, factor: int) -> np.ndarray:
    """The middle pixel of each `factor` x `factor` pixels of an image [H, W]; rows and columns left over are cut."""
    rows, columns = (side // factor * factor for side in image.shape[:2])
    return np.ascontiguousarray(image[factor // 2 : rows : factor, factor // 2 : columns : factor])


def _window(factor: int) -> int:
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


def compare(view: CoarseView, other: CoarseView, margin: Margin, moved: np.ndarray | None = None) -> PairEvidence:
    """What `other` says of what `view` sees.

    Args:
        view: see there.
        other: see there.
        margin: see there.
        moved: places of `view`, bool [h, w], that say nothing of how much depths of one surface differ.
    """
    camera = other.camera
    T_other_view = (inverse(other.T_world_camera) @ view.T_world_camera).astype(np.float32)
    points = transform_points(view.camera.back_project(view.depth).reshape(-1, 3), T_other_view)
    z = points[:, 2]
    ahead = np.maximum(z, np.float32(1e-3))
    u = np.float32(camera.fx) * points[:, 0] / ahead + np.float32(camera.cx)
    v = np.float32(camera.fy) * points[:, 1] / ahead + np.float32(camera.cy)
    inside = (view.depth.reshape(-1) > 0) & (z > 1e-3)
    inside &= (u >= -0.5) & (v >= -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
    column, row = (u + np.float32(0.5)).astype(np.int32), (v + np.float32(0.5)).astype(np.int32)
    where = np.where(inside, row * camera.width + column, 0)
    near, far = other.near.reshape(-1)[where], other.far.reshape(-1)[where]
    known = inside & other.whole.reshape(-1)[where]
    smooth = known & view.smooth.reshape(-1) & other.smooth.reshape(-1)[where]
    told = np.flatnonzero(smooth if moved is None else smooth & ~moved.reshape(-1))[::EVERY]
    share = _measured_share(other, margin, u[told], v[told], z[told])
    slack = margin(z, np.where(smooth, share, ROUGH).astype(np.float32))
    passed, clearly = known & (near > z + slack), known & (near > z + 2 * slack)
    same = inside & (near < z + slack) & (far > z - slack)
    return PairEvidence(
        *(found.reshape(view.depth.shape) for found in (passed, clearly, clearly & smooth, same, known & ~same))
    )


def _measured_share(other: CoarseView, margin: Margin, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> float:
    """How large differences between means of depth are, in standard deviations of a pixel, as most of them are.

    Args:
        other: a view.
        margin: see there.
        u: float32 [n], columns of points in it...
        v: ...rows...
        z: ...and depths.
    """
    if len(z) < FEWEST:
        return ROUGH
    left = np.clip(u.astype(np.int32), 0, other.camera.width - 2)
    top = np.clip(v.astype(np.int32), 0, other.camera.height - 2)
    a, b, depth = u - left, v - top, other.depth
    upper = (1 - a) * depth[top, left] + a * depth[top, left + 1]
    lower = (1 - a) * depth[top + 1, left] + a * depth[top + 1, left + 1]
    off = np.abs((1 - b) * upper + b * lower - z) / margin.sigma(z)
    return float(np.clip(NEAREST * np.median(off) / 0.6745, LEAST_SHARE, ROUGH))
