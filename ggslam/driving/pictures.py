# SPDX-License-Identifier: Apache-2.0
"""Pictures of what a robot meets, for people: costs in colours, obstacles black, the robot to scale."""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.driving.bands import BandMap
from ggslam.driving.inflation import INSCRIBED_COST, LETHAL_COST, UNKNOWN_COST
from ggslam.system.tuning import Tuning
from ggslam.volumes.slices import magnification


class BandPictureTuning(Tuning):
    """How such pictures are drawn."""

    smallest_side = 480
    """Fewest pixels of the map's shorter side."""
    caption_height = 64
    """Height of the space below, in pixels."""


_FREE, _UNKNOWN, _LETHAL, _INSCRIBED = (255, 255, 255), (176, 176, 176), (0, 0, 0), (172, 30, 40)
_NEAR, _FAR = np.array([232, 96, 46]), np.array([253, 244, 190])
"""Colours of the largest and the smallest cost."""


def cost_colors(cost: np.ndarray) -> np.ndarray:
    """Costs uint8 [H, W] as colours uint8 [H, W, 3]: white free, from light yellow to orange dear, dark red where the
    robot would touch an obstacle, black obstacles, grey unknown."""
    table = np.zeros((256, 3), np.uint8)
    share = np.arange(256)[:, None] / (INSCRIBED_COST - 1)
    table[:] = np.clip(_FAR + share * (_NEAR - _FAR), 0, 255)
    for value, color in ((0, _FREE), (UNKNOWN_COST, _UNKNOWN), (LETHAL_COST, _LETHAL), (INSCRIBED_COST, _INSCRIBED)):
        table[value] = color
    return np.asarray(table[cost])


def band_picture(band: BandMap, cost: np.ndarray, radius: float, title: str) -> np.ndarray:
    """The costs of a robot from above, x to the right, with a scale, the robot as a blue circle, and a caption,
    uint8 [H, W, 3].

    Args:
        band: what it meets.
        cost: uint8 [H, W].
        radius: of the robot, metres.
        title: what is shown.
    """
    times = magnification(cost.shape, BandPictureTuning.smallest_side)
    picture = cost_colors(cost).repeat(times, 0).repeat(times, 1)
    scale = times / band.resolution
    _draw_axes(picture, band, scale)
    _draw_robot(picture, band, radius, times)
    width = max(picture.shape[1], 560)
    foot = np.full((BandPictureTuning.caption_height, width, 3), 255, np.uint8)
    side = np.full((picture.shape[0], width - picture.shape[1], 3), 255, np.uint8)
    _write(foot, title, (8, 20))
    metres = _round_length(0.3 * width / scale)
    cv2.line(foot, (8, 36), (8 + round(metres * scale), 36), (0, 0, 0), 3)
    _write(foot, f"{metres:g} m", (8, 56))
    place = 150
    for color, word in (
        (_LETHAL, "obstacle"),
        (_INSCRIBED, "collision"),
        (_NEAR.tolist(), "near"),
        (_UNKNOWN, "unknown"),
    ):
        cv2.rectangle(foot, (place, 46), (place + 12, 58), color, -1)
        _write(foot, word, (place + 17, 57))
        place += 100
    return np.concatenate([np.concatenate([picture, side], 1), foot])


def _draw_axes(picture: np.ndarray, band: BandMap, scale: float) -> None:
    """x red and y green, half a metre each, where the plane's origin is, if it is in the picture."""
    low, rows = band.plane.low, picture.shape[0]
    origin = (round(-low[0] * scale), rows - 1 - round(-low[1] * scale))
    if 0 <= origin[0] < picture.shape[1] and 0 <= origin[1] < rows:
        long = round(0.5 * scale)
        cv2.arrowedLine(picture, origin, (origin[0] + long, origin[1]), (220, 0, 0), 2, cv2.LINE_AA, tipLength=0.2)
        cv2.arrowedLine(picture, origin, (origin[0], origin[1] - long), (0, 150, 0), 2, cv2.LINE_AA, tipLength=0.2)


def _draw_robot(picture: np.ndarray, band: BandMap, radius: float, times: int) -> None:
    """Where there is most space."""
    room = cv2.distanceTransform(band.free.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    row, column = np.unravel_index(int(room.argmax()), room.shape)
    if room[row, column] > 0:
        place = (round((column + 0.5) * times), round((row + 0.5) * times))
        cv2.circle(picture, place, max(2, round(radius * times / band.resolution)), (40, 90, 200), 2, cv2.LINE_AA)


def _round_length(most: float) -> float:
    """The largest of 1, 2, 5, 10 ... that is not above."""
    power = 10.0 ** np.floor(np.log10(max(most, 1e-6)))
    return float(max(step * power for step in (1, 2, 5) if step * power <= most * (1 + 1e-9)))


def _write(picture: np.ndarray, text: str, place: tuple[int, int]) -> None:
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
