# SPDX-License-Identifier: Apache-2.0
"""Detects from images that the camera stands still.

On a tripod geometry is misled by whoever moves before the camera; most of the image, though, stays where it is to a
hundredth of a pixel. Textured pixels of an anchor frame are compared with the same ones of a frame: their grey values,
their number all over the image, and their depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.abi.arrays import address
from ggslam.abi.core import StillPixelsJob
from ggslam.native.loader import load_library
from ggslam.system.array_forms import DepthImage, Pose
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.settings import DepthNoise


class StillTuning(Tuning):
    """When the camera stands still."""

    width = 160
    """Width, in pixels, of the compared images."""
    min_gradient = 6.0
    """Smallest gradient of a textured pixel, in grey levels per pixel."""
    min_pixels = 150
    """Fewest textured pixels of a decision."""
    max_pixels = 2500
    """Most textured pixels that are compared."""
    max_flow_pixels = 0.5
    """Largest flow, in pixels across its edge, of a textured pixel that may be still."""
    max_shift_pixels = 0.03
    """Largest mean shift of all pixels, in pixels: sideways, by rotation at the image corner, or by approach."""
    cells = 4
    """Parts of the image along each axis."""
    min_cell_pixels = 8
    """Fewest textured pixels of a part that counts."""
    min_still_cells = 0.5
    """Smallest share of these parts that must be still."""
    min_still_share = 0.5
    """Smallest share of still pixels in a still part, and along each direction."""
    across = 0.7
    """Smallest component along a direction of the unit gradient of a pixel that tells about motion along it."""
    min_across = 50
    """Fewest such pixels for each direction. Edges along a motion look still however fast it is."""
    min_still_depth = 0.6
    """Smallest share of the still pixels whose depth is unchanged."""
    depth_sigmas = 4.0
    """Largest change of unchanged depth, in standard deviations."""
    mostly = 0.5
    """Share of a run's frames from which the camera is reported as still."""


@savable(not_saved="planes address", after="prepare")
@dataclass
class SmallFrame:
    """A frame at reduced size: grey values float32 [h, w] of 0 to 255, and depth float32 [h, w], metres, 0: unknown.

    Attributes:
        planes: float32 [5, h, w]: grey values, blurred; their gradients along rows and along columns, grey levels per
            pixel; depth; grey values.
        address: of these.
    """

    grey: DepthImage
    depth: DepthImage
    planes: np.ndarray | None = None
    address: int | None = None

    @staticmethod
    def of(color: np.ndarray, depth: np.ndarray) -> SmallFrame:
        """Of colour uint8 [H, W, 3] and depth float32 [H, W]."""
        width, height = StillTuning.width, max(2, round(color.shape[0] * StillTuning.width / color.shape[1]))
        planes, factor = np.empty((5, height, width), np.float32), color.shape[1] // width
        grey, first = planes[4], address(planes)
        if 0 < factor <= 16 and color.shape == (factor * height, factor * width, 3) and color.flags.c_contiguous:
            load_library().ggslam_shrink_grey(address(color), *color.shape[:2], factor, first + 4 * grey.nbytes)
        else:
            small = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA)
            grey[...] = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        cv2.resize(depth, (width, height), dst=planes[3], interpolation=cv2.INTER_NEAREST)
        _fill_planes(planes)
        return SmallFrame(grey, planes[3], planes, first)

    def prepare(self) -> None:
        """Makes `planes`, where grey values and depth were given."""
        if self.planes is None:
            self.planes = np.empty((5, *self.grey.shape), np.float32)
            self.planes[3], self.planes[4] = self.depth, self.grey
            _fill_planes(self.planes)
        self.address = address(self.planes)


def _fill_planes(planes: np.ndarray) -> None:
    """Makes the first three of `SmallFrame.planes`."""
    smooth, gx, gy, _, grey = planes
    cv2.GaussianBlur(grey, (3, 3), 0.7, dst=smooth)
    cv2.Sobel(smooth, cv2.CV_32F, 1, 0, dst=gx, ksize=3, scale=1 / 8)
    cv2.Sobel(smooth, cv2.CV_32F, 0, 1, dst=gy, ksize=3, scale=1 / 8)


@savable()
@dataclass
class StillCamera:
    """Remembers the frame since which the camera may have stood still.

    Attributes:
        anchor: that frame; None: there is none.
        T_world_camera: float64 [4, 4], its pose.
        frames: how many were held in its place so far, in all.
    """

    anchor: SmallFrame | None = None
    T_world_camera: Pose | None = None
    frames: int = 0

    def holds(self, small: SmallFrame, noise: DepthNoise) -> bool:
        """Whether the camera still is where the anchor was taken."""
        return self.anchor is not None and is_still(self.anchor, small, noise)

    def renew(self, small: SmallFrame, T_world_camera: np.ndarray) -> None:
        """The camera has moved, and is at a pose [4, 4]."""
        self.anchor, self.T_world_camera = small, T_world_camera.copy()

    def forget(self) -> None:
        """Nothing is known of where the camera is."""
        self.anchor = self.T_world_camera = None

    def move(self, T_new_old: np.ndarray) -> None:
        """Follows a correction [4, 4] of the world about the camera."""
        if self.T_world_camera is not None:
            self.T_world_camera = T_new_old @ self.T_world_camera


def is_still(anchor: SmallFrame, now: SmallFrame, noise: DepthNoise) -> bool:
    """Whether two frames of one size were taken from the same place, whatever moves before the camera."""
    if anchor.grey.shape != now.grey.shape:
        return False
    assert anchor.planes is not None and now.planes is not None
    pixels, stays = _pixels_that_stay(anchor, now)
    if not len(pixels):
        return False
    rows, columns = np.divmod(pixels, anchor.grey.shape[1])
    grey, gx, gy, before = anchor.planes.reshape(5, -1)[:4, pixels]
    smooth, _, _, after = now.planes.reshape(5, -1)[:4, pixels]
    shifts = _shifts(rows, columns, gx, gy, grey, smooth - grey, stays, anchor.grey.shape)
    if shifts is None or np.abs(shifts).max() > StillTuning.max_shift_pixels:
        return False
    before, after = before[stays], after[stays]
    same = np.abs(after - before) < StillTuning.depth_sigmas * (noise.constant + noise.square * before * before) + 1e-3
    return bool(same.mean() >= StillTuning.min_still_depth)


def _pixels_that_stay(anchor: SmallFrame, now: SmallFrame) -> tuple[np.ndarray, np.ndarray]:
    """Textured pixels, by their number in the image, int32 [n], and whether each stays, bool [n]. None of them if too
    few stay, in too few parts of the image, or along one direction."""
    found = np.empty(2 * StillTuning.max_pixels, np.int32)
    count = load_library().ggslam_still_pixels(StillPixelsJob(
        anchor.address, now.address, *anchor.grey.shape, StillTuning.min_gradient**2, StillTuning.max_flow_pixels,
        StillTuning.min_pixels, StillTuning.max_pixels, StillTuning.cells, StillTuning.min_cell_pixels,
        StillTuning.min_still_cells, StillTuning.min_still_share, StillTuning.across, StillTuning.min_across,
        address(found),
    ))  # fmt: skip
    return found[:count] >> 1, (found[:count] & 1) > 0


def _shifts(
    rows: np.ndarray, columns: np.ndarray, gx: np.ndarray, gy: np.ndarray, grey: np.ndarray, difference: np.ndarray,
    stays: np.ndarray, shape: tuple[int, ...],
) -> np.ndarray | None:  # fmt: skip
    """By how much the pixels that stay have shifted: along columns and rows, turned and grown, each in pixels (of the
    latter two at the image's corner), [4], apart from a change of exposure; None: it cannot be told.

    Brightness constancy, difference = -gradient . shift (Lucas and Kanade, IJCAI 1981), by least squares over the
    pixels that agree.
    """
    x, y = columns - (shape[1] - 1) / 2, rows - (shape[0] - 1) / 2
    corner = np.hypot(shape[0], shape[1]) / 2
    A = np.stack(
        [-gx, -gy, (gx * y - gy * x) / corner, -(gx * x + gy * y) / corner, grey - 128, np.ones(len(grey))], 1
    ).astype(float)
    slope = np.maximum(np.hypot(gx, gy), 1e-3)
    agree = stays
    for _ in range(3):
        if agree.sum() < StillTuning.min_pixels:
            return None
        found = np.linalg.lstsq(A[agree].T @ A[agree], A[agree].T @ difference[agree], rcond=None)[0]
        agree = stays & (np.abs(difference - A @ found) < StillTuning.max_flow_pixels / 2 * slope)
    return found[:4]


def still_notes(still: int, frames: int) -> list[str]:
    """What the user should know of a run of so many frames, in so many of which the camera stood still."""
    if still < StillTuning.mostly * frames:
        return []
    return [f"the camera stands still in {still} of {frames} frames: its pose is held in them"]
