# SPDX-License-Identifier: Apache-2.0
"""Every n-th pixel of every n-th row of an image, as a smaller image.

The map rendered by the grid's camera with the grid's low-pass filter has at each pixel what the whole image has there,
to rounding: nothing is averaged. The loss is the whole image's at fewer pixels, but for SSIM, whose windows reach n
times as far. Neighbouring pixels tell much the same where images are noisy, so that steps on fewer pixels of more views
teach more in the same time; see `MapperSettings.sparse_noise`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class PixelGridTuning(Tuning):
    """Training on a part of the pixels."""

    min_size = 32
    """Fewest pixels of a grid, or of a picture of half the size, along each side. Smaller images use all pixels."""


_ORDER: Final = ((0, 0), (1, 1), (0, 1), (1, 0))
"""Offsets (row, column) of the four grids of every second pixel, in the order of their turns."""


@dataclass(frozen=True)
class PixelGrid:
    """The pixels of such a grid.

    Attributes:
        stride: every so manyth of each row and column.
        row, column: the first of them, below `stride`.
    """

    stride: int = 1
    row: int = 0
    column: int = 0

    @cached_property
    def is_whole(self) -> bool:
        """Whether it has all pixels."""
        return self.stride == 1

    def of(self, image: np.ndarray) -> np.ndarray:
        """The grid's pixels [h, w, ...] of an image [H, W, ...], where they lie in it."""
        return image if self.is_whole else image[self.row :: self.stride, self.column :: self.stride]

    def color_of(self, color: np.ndarray) -> np.ndarray:
        """What a step is compared with, of a colour image uint8 [H, W, 3]."""
        return self.of(color)

    def depth_of(self, depth: np.ndarray) -> np.ndarray:
        """The same of a depth image [H, W], 0 where there is none."""
        return self.of(depth)

    def valid_of(self, shown: np.ndarray) -> np.ndarray:
        """The same of which pixels count, bool [H, W]."""
        return self.of(shown)

    def camera(self, camera: Camera) -> Camera:
        """The camera whose whole image has the grid's pixels of `camera`'s, through the same rays."""
        n = self.stride
        return Camera(
            -(-(camera.width - self.column) // n), -(-(camera.height - self.row) // n), camera.fx / n, camera.fy / n,
            (camera.cx - self.column) / n, (camera.cy - self.row) / n,
        )  # fmt: skip

    def low_pass(self, low_pass: float) -> float:
        """The filter of the whole image (pixels^2) in pixels of the grid."""
        return low_pass / self.stride**2


ALL_PIXELS = PixelGrid()


def is_divisible(camera: Camera) -> bool:
    """Whether images are large enough to be trained on at half of their rows and columns."""
    return min(camera.width, camera.height) >= 2 * PixelGridTuning.min_size


def grid_of_turn(turn: int, camera: Camera) -> PixelGrid:
    """The grid of a view's next step, of which `turn` counts those before: every second pixel. In four turns each
    pixel comes once."""
    if not is_divisible(camera):
        return ALL_PIXELS
    return PixelGrid(2, *_ORDER[turn % 4])
