# SPDX-License-Identifier: Apache-2.0
"""Steps on pictures of other sizes than the recording's.

A renderer widens projected Gaussians by a filter of its own pixels. A map that is only ever seen at one size learns
details that exist with that filter alone: smaller, they grow together, larger, gaps open between them. Steps that look
at it at half and at twice the size keep Gaussians to what looks right at all three.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from ggslam.mapping.pixel_grid import ALL_PIXELS, PixelGrid, is_divisible
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class OtherSizeTuning(Tuning):
    """Training at other sizes than the recording's."""

    share = 0.4
    """Part of the final refinement, its first one, of which half of the steps are on other sizes. The later ones
    sharpen the map at its own size."""
    later_every = 20
    """Of so many of the later steps one is on half and one on twice the size. Without them the map forgets in the
    later part half of what it learned in the first."""
    alike = 1.02
    """Depths that differ by this factor are not averaged: they are of different surfaces."""


@dataclass(frozen=True)
class HalfSize(PixelGrid):
    """The picture at half the size: each pixel the mean of four."""

    stride: int = 2

    def of(self, image: np.ndarray) -> np.ndarray:
        """One pixel of each four."""
        height, width = image.shape[:2]
        return image[: height // 2 * 2 : 2, : width // 2 * 2 : 2]

    def color_of(self, color: np.ndarray) -> np.ndarray:
        height, width = color.shape[0] // 2, color.shape[1] // 2
        return cv2.resize(color[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)

    def depth_of(self, depth: np.ndarray) -> np.ndarray:
        four = _four(depth).astype(np.float32)
        good = (four.min(0) > 0) & (four.max(0) < OtherSizeTuning.alike * four.min(0))
        return np.where(good, np.rint(four.mean(0)) if depth.dtype.kind == "u" else four.mean(0), 0).astype(depth.dtype)

    def valid_of(self, shown: np.ndarray) -> np.ndarray:
        return np.asarray(_four(shown).all(0))

    def camera(self, camera: Camera) -> Camera:
        return Camera(
            camera.width // 2, camera.height // 2, camera.fx / 2, camera.fy / 2, camera.cx / 2 - 0.25,
            camera.cy / 2 - 0.25,
        )  # fmt: skip

    def low_pass(self, low_pass: float) -> float:
        return low_pass


@dataclass(frozen=True)
class TwiceTheSize(PixelGrid):
    """As the picture of twice the size looks, each four pixels of it averaged: its filter, and the spread of four
    samples. That has to be the recording's picture."""

    def low_pass(self, low_pass: float) -> float:
        return low_pass / 4 + 1 / 16


_HALF: Final = HalfSize()
_TWICE: Final = TwiceTheSize()
_TURNS: Final = (ALL_PIXELS, _HALF, _TWICE, ALL_PIXELS)


def picture_of_turn(turn: int, done: float, camera: Camera) -> PixelGrid:
    """What the `turn`-th step of the final refinement looks at, of which `done`, 0 to 1, is over."""
    if not is_divisible(camera):
        return ALL_PIXELS
    if done < OtherSizeTuning.share:
        return _TURNS[turn % len(_TURNS)]
    every = OtherSizeTuning.later_every
    others = {every // 4: _HALF, 3 * every // 4: _TWICE}
    return others.get(turn % every, ALL_PIXELS)


def _four(image: np.ndarray) -> np.ndarray:
    """The pixels [4, h, w] that become one."""
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return np.stack([image[row:height:2, column:width:2] for row in (0, 1) for column in (0, 1)])
