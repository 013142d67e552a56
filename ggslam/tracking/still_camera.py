# SPDX-License-Identifier: Apache-2.0
"""Detects from images that the camera stands still.

On a tripod geometry is misled by whoever moves before the camera; most of the image, though, stays where it is to a
hundredth of a pixel. Textured pixels of an anchor frame are compared with the same ones of a frame: their grey values,
their number all over the image, and their depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from ggslam.system.array_forms import DepthImage, Pose
from ggslam.system.medians import median
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


WAYS: Final = ((1.0, 0.0), (0.7071, 0.7071), (0.0, 1.0), (-0.7071, 0.7071))
"""Unit vectors of the four directions in the image along which motion is tested."""


@savable()
@dataclass(frozen=True)
class SmallFrame:
    """A frame at reduced size: grey values float32 [h, w] of 0 to 255, and depth float32 [h, w], metres, 0: unknown."""

    grey: DepthImage
    depth: DepthImage

    @staticmethod
    def of(color: np.ndarray, depth: np.ndarray) -> SmallFrame:
        """Of colour uint8 [H, W, 3] and depth float32 [H, W]."""
        size = (StillTuning.width, max(2, round(color.shape[0] * StillTuning.width / color.shape[1])))
        grey = cv2.cvtColor(cv2.resize(color, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
        return SmallFrame(grey.astype(np.float32), cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST))


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
    smooth = cv2.GaussianBlur(anchor.grey, (3, 3), 0.7)
    gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
    gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
    textured = (gx * gx + gy * gy > StillTuning.min_gradient**2) & (anchor.depth > 0) & (now.depth > 0)
    rows, columns = textured.nonzero()
    if len(rows) < StillTuning.min_pixels:
        return False
    step = max(1, len(rows) // StillTuning.max_pixels)
    rows, columns = rows[::step], columns[::step]
    gx, gy = gx[rows, columns], gy[rows, columns]
    difference = cv2.GaussianBlur(now.grey, (3, 3), 0.7)[rows, columns] - smooth[rows, columns]
    slope = np.hypot(gx, gy)
    stays = np.abs(difference - median(difference)) < StillTuning.max_flow_pixels * slope
    if not (_is_all_over(rows, columns, stays, anchor.grey.shape) and _stays_each_way(gx / slope, gy / slope, stays)):
        return False
    shifts = _shifts(rows, columns, gx, gy, smooth[rows, columns], difference, stays, anchor.grey.shape)
    if shifts is None or np.abs(shifts).max() > StillTuning.max_shift_pixels:
        return False
    before, after = anchor.depth[rows, columns][stays], now.depth[rows, columns][stays]
    same = np.abs(after - before) < StillTuning.depth_sigmas * (noise.constant + noise.square * before * before) + 1e-3
    return bool(same.mean() >= StillTuning.min_still_depth)


def _is_all_over(rows: np.ndarray, columns: np.ndarray, stays: np.ndarray, shape: tuple[int, ...]) -> bool:
    """Whether pixels that stay are most of the textured ones in most parts of the image."""
    cells = rows * StillTuning.cells // shape[0] * StillTuning.cells + columns * StillTuning.cells // shape[1]
    textured = np.bincount(cells, minlength=StillTuning.cells**2)
    still = np.bincount(cells[stays], minlength=StillTuning.cells**2)
    counted = textured >= StillTuning.min_cell_pixels
    stay = counted & (still >= StillTuning.min_still_share * textured)
    count = np.add.reduce(counted)
    return bool(count >= StillTuning.cells and np.add.reduce(stay) >= StillTuning.min_still_cells * count)


def _stays_each_way(x: np.ndarray, y: np.ndarray, stays: np.ndarray) -> bool:
    """Whether, for each direction in the image, most of the pixels stay that would show a motion along it; `x`, `y`:
    unit gradients."""
    telling = [np.abs(x * way[0] + y * way[1]) >= StillTuning.across for way in WAYS]
    return all(
        one.sum() >= StillTuning.min_across and stays[one].mean() >= StillTuning.min_still_share for one in telling
    )


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
