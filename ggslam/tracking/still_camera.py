# SPDX-License-Identifier: Apache-2.0
"""Whether the camera stands still, told by the image itself.

On a tripod geometry is misled by whoever moves before the camera; most of the image, though, stays where it is to a
hundredth of a pixel. Textured pixels of an anchor frame are compared with the same ones of a frame: their grey values,
their number all over the image, and their depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.system.array_forms import DepthImage, Pose
from ggslam.system.savable import savable
from ggslam.tracking.settings import DepthNoise

WIDTH = 160
"""Pixels of the images that are compared."""
LEAST_GRADIENT = 6.0
"""Grey levels per pixel from which a pixel is textured."""
FEWEST, MOST = 150, 2500
"""Textured pixels that tell anything, and of more so many are looked at."""
LARGEST_FLOW = 0.5
"""Pixels by which a textured pixel moves, across its edge, that may not have moved at all."""
LARGEST_SHIFT = 0.03
"""Pixels by which all of them may have shifted on the average, turned (at the image's corner) or come closer."""
CELLS, CELL_PIXELS = 4, 8
"""The image has `CELLS` x `CELLS` parts, of which those count that have so many textured pixels..."""
STILL_CELLS, STILL_SHARE = 0.5, 0.5
"""...and such a share of them has to stand still: such a share of its pixels."""
WAYS = ((1.0, 0.0), (0.7071, 0.7071), (0.0, 1.0), (-0.7071, 0.7071))
"""Directions in the image; along each..."""
ACROSS, FEWEST_ACROSS = 0.7, 50
"""...motion is told by pixels whose gradient lies along it to this share; there must be so many, and `STILL_SHARE` of
them has to stay: edges along a motion stay, however far it goes."""
STILL_DEPTH, DEPTH_SIGMAS = 0.6, 4.0
"""Share of the pixels that stand still whose depth stays, within so many standard deviations."""
MOSTLY = 0.5
"""Share of a run's frames from which it is said that the camera stands still."""


@savable()
@dataclass(frozen=True)
class SmallFrame:
    """A frame at reduced size: grey values float32 [h, w] of 0 to 255, and depth float32 [h, w], metres, 0: unknown."""

    grey: DepthImage
    depth: DepthImage

    @staticmethod
    def of(color: np.ndarray, depth: np.ndarray) -> SmallFrame:
        """Of colour uint8 [H, W, 3] and depth float32 [H, W]."""
        size = (WIDTH, max(2, round(color.shape[0] * WIDTH / color.shape[1])))
        grey = cv2.cvtColor(cv2.resize(color, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
        return SmallFrame(grey.astype(np.float32), cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST))


@savable()
@dataclass
class StillCamera:
    """Remembers the frame that the camera may have stood still since.

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
    gx, gy = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    rows, columns = np.nonzero((gx * gx + gy * gy > LEAST_GRADIENT**2) & (anchor.depth > 0) & (now.depth > 0))
    if len(rows) < FEWEST:
        return False
    step = max(1, len(rows) // MOST)
    rows, columns = rows[::step], columns[::step]
    gx, gy = gx[rows, columns], gy[rows, columns]
    difference = cv2.GaussianBlur(now.grey, (3, 3), 0.7)[rows, columns] - smooth[rows, columns]
    slope = np.hypot(gx, gy)
    stays = np.abs(difference - np.median(difference)) < LARGEST_FLOW * slope
    if not (_is_all_over(rows, columns, stays, anchor.grey.shape) and _stays_each_way(gx / slope, gy / slope, stays)):
        return False
    shifts = _shifts(rows, columns, gx, gy, smooth[rows, columns], difference, stays, anchor.grey.shape)
    if shifts is None or np.abs(shifts).max() > LARGEST_SHIFT:
        return False
    before, after = anchor.depth[rows, columns][stays], now.depth[rows, columns][stays]
    same = np.abs(after - before) < DEPTH_SIGMAS * (noise.constant + noise.square * before * before) + 1e-3
    return bool(same.mean() >= STILL_DEPTH)


def _is_all_over(rows: np.ndarray, columns: np.ndarray, stays: np.ndarray, shape: tuple[int, ...]) -> bool:
    """Whether pixels that stay are most of the textured ones in most parts of the image."""
    cells = rows * CELLS // shape[0] * CELLS + columns * CELLS // shape[1]
    textured = np.bincount(cells, minlength=CELLS**2)
    still = np.bincount(cells[stays], minlength=CELLS**2)
    counted = textured >= CELL_PIXELS
    return bool(counted.sum() >= CELLS and (still[counted] >= STILL_SHARE * textured[counted]).mean() >= STILL_CELLS)


def _stays_each_way(x: np.ndarray, y: np.ndarray, stays: np.ndarray) -> bool:
    """Whether, for each direction in the image, most of the pixels stay that would show a motion along it; `x`, `y`:
    unit gradients."""
    telling = [np.abs(x * way[0] + y * way[1]) >= ACROSS for way in WAYS]
    return all(one.sum() >= FEWEST_ACROSS and stays[one].mean() >= STILL_SHARE for one in telling)


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
        if agree.sum() < FEWEST:
            return None
        found = np.linalg.lstsq(A[agree].T @ A[agree], A[agree].T @ difference[agree], rcond=None)[0]
        agree = stays & (np.abs(difference - A @ found) < LARGEST_FLOW / 2 * slope)
    return found[:4]


def still_notes(still: int, frames: int) -> list[str]:
    """What the user should know of a run of so many frames, in so many of which the camera stood still."""
    if still < MOSTLY * frames:
        return []
    return [f"the camera stands still in {still} of {frames} frames: its pose is held in them"]
