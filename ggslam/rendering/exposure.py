# SPDX-License-Identifier: Apache-2.0
"""Exposure of an image against a rendering of the same view: corrected = gain * rendered + offset per channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from ggslam.system.tuning import Tuning


class ExposureTuning(Tuning):
    """Comparison of an image with a rendering."""

    min_alpha = 0.9
    """Smallest opacity of the rendering at a pixel that is compared."""
    max_depth_error = 0.05
    """Largest error of the rendered depth at such a pixel, as a share of the measured depth."""
    dark = 0.04
    """Values below this one, in [0, 1], are not compared: they are black level."""
    bright = 0.98
    """Values above this one, in [0, 1], are not compared: they are saturated."""
    min_share = 0.02
    """Smallest share of pixels left for a comparison."""
    stride = 2
    """One in this many rows and columns is compared."""
    min_lit_share = 0.3
    """Smallest share of pixels, neither dark nor saturated, of an image that shows colours."""
    contradiction = 0.15
    """Median difference of grey values, in [0, 1], from which image and map show different scenes."""


_SOME = (slice(None, None, ExposureTuning.stride), slice(None, None, ExposureTuning.stride))


_IDENTITY = np.tile([1.0, 0.0], (3, 1))


def identity_exposure() -> np.ndarray:
    """Gain 1 and offset 0 for each channel, float64 [3, 2]."""
    return _IDENTITY.copy()


def change_of(exposure: np.ndarray) -> float:
    """How bright an exposure [3, 2] is against the map: the geometric mean of its gains."""
    return float(np.exp(np.log(np.maximum(exposure[:, 0], 1e-6)).mean()))


def frame_weights(numbers: Sequence[int]) -> np.ndarray:
    """Frames for which keyframes of these numbers stand, [n]: up to the next one, the last for as many as the one
    before it; one at least."""
    gaps = np.diff(np.asarray(numbers, np.float64))
    return np.maximum(np.append(gaps, gaps[-1:] if len(gaps) else 1), 1)


def typical_gain(gains: Sequence[np.ndarray], weights: np.ndarray) -> np.ndarray:
    """Weighted median of gains against a map, [3] each, by channel; where half of the weight lies on either side the
    nearer to the map's, which is 1."""
    found = np.ones(3)
    for channel in range(3):
        values = np.maximum([gain[channel] for gain in gains], 1e-3)
        order = np.argsort(values, kind="stable")
        share = np.cumsum(weights[order]) / weights.sum()
        low, high = (values[order[np.searchsorted(share, 0.5, side=side)]] for side in ("left", "right"))
        found[channel] = np.clip(1.0, low, high)
    return found


class Seen(Protocol):
    """What a map shows where an image looks, as that is compared with it."""

    def measure(self, color: np.ndarray) -> np.ndarray | None:
        """Exposure [3, 2] of the image, uint8 [H, W, 3], against the map; None if too little is seen by both."""

    def pictures(self) -> SeenAgain:
        """The pictures themselves."""


@dataclass(frozen=True)
class SeenAgain:
    """The map, rendered at the pose of an image.

    Attributes:
        image: rendered colour [3, H, W].
        alpha: of the rendering [H, W].
        rendered_depth: metres [H, W].
        depth: what the camera measured [H, W], metres, 0 = none.
        thinned: whether these have only the rows and columns that are compared, one in `ExposureTuning.stride`; good
            for all but `relative_sharpness`.
    """

    image: np.ndarray
    alpha: np.ndarray
    rendered_depth: np.ndarray
    depth: np.ndarray
    thinned: bool = False

    def pictures(self) -> SeenAgain:
        """Itself, see `Seen`."""
        return self

    def some(self, image: np.ndarray) -> np.ndarray:
        """The rows and columns that are compared, of an image [H, W]."""
        return image if self.thinned else image[_SOME]

    def common_pixels(self) -> np.ndarray:
        """Which of every STEP-th row and column both see, bool [h, w]."""
        depth, rendered_depth = self.some(self.depth), self.some(self.rendered_depth)
        near = np.abs(rendered_depth - depth) < ExposureTuning.max_depth_error * depth
        return np.asarray((depth > 0) & (self.some(self.alpha) > ExposureTuning.min_alpha) & near)

    def measure(self, color: np.ndarray) -> np.ndarray | None:
        """`measure_exposure` of what the camera saw, uint8 [H, W, 3]."""
        known = self.common_pixels()
        gains = []
        for channel in range(3):
            x, y = self.some(self.image[channel])[known], color[_SOME][..., channel][known].astype(np.float32) / 255
            used = (x > ExposureTuning.dark) & (x < ExposureTuning.bright) & (y < ExposureTuning.bright)
            if not is_enough(int(used.sum()), known.size):
                return None
            gains.append(_median(y[used] / x[used]))
        return exposure_of(gains)


def is_enough(used: int, pixels: int) -> bool:
    """Whether so many of the pixels that are compared tell of an exposure."""
    return used >= ExposureTuning.min_share * pixels


def exposure_of(gains: Sequence[float]) -> np.ndarray | None:
    """The exposure [3, 2] with these gains and no offsets; None if one is impossible."""
    exposure = identity_exposure()
    exposure[:, 0] = gains
    return exposure if (exposure[:, 0] > 0).all() else None


def is_lit(color: np.ndarray) -> bool:
    """Whether an image uint8 [H, W, 3] shows colours: it is neither nearly black nor saturated nearly everywhere."""
    some = color[_SOME]
    sums = some[..., 0].astype(np.uint16)
    sums += some[..., 1]
    sums += some[..., 2]
    first, last = _lit_sums(ExposureTuning.dark, ExposureTuning.bright)
    lit = np.count_nonzero((sums >= first) & (sums <= last))
    return bool(lit / sums.size >= ExposureTuning.min_lit_share)


@lru_cache(maxsize=4)
def _lit_sums(dark: float, bright: float) -> tuple[np.uint16, np.uint16]:
    """Least and largest sum of a pixel's three channels whose mean, in [0, 1], lies between these two."""
    grey = np.arange(3 * 255 + 1, dtype=np.float32) / np.float32(3) / 255
    lit = np.flatnonzero((grey > dark) & (grey < bright)).astype(np.uint16)
    return lit[0], lit[-1]


def shows_otherwise(color: np.ndarray, seen: SeenAgain) -> bool:
    """Whether a map and an image uint8 [H, W, 3] that is not lit, or a map of such images and one that is, contradict
    each other; what is black or white in the scene is so in both."""
    known = seen.common_pixels()
    if known.mean() < ExposureTuning.min_share:
        return False
    grey = color[_SOME].astype(np.float32).mean(2) / 255
    return bool(np.median(np.abs(grey - seen.some(seen.image.mean(0)))[known]) > ExposureTuning.contradiction)


def measure_exposure(
    color: np.ndarray, depth: np.ndarray, image: np.ndarray, alpha: np.ndarray, rendered_depth: np.ndarray
) -> np.ndarray | None:
    """Gain of each channel, with offset 0, that turns a rendering into what a camera saw; float64 [3, 2], None if too
    little is seen by both.

    It is the median of the ratios of pixels, which a few new or moved things and reflections do not disturb. With
    images encoded by a power law a change of exposure is a gain of the encoded values too.

    Args:
        color: uint8 [H, W, 3], what the camera saw.
        depth: [H, W], metres, 0 = none.
        image: rendered colour [3, H, W].
        alpha, rendered_depth: of the rendering [H, W].
    """
    return SeenAgain(image, alpha, rendered_depth, depth).measure(color)


def _median(values: np.ndarray) -> float:
    """The same as `np.median` of numbers [N] that are not NaN, in a fraction of its time."""
    middle = len(values) // 2
    parted = np.partition(values, middle)
    upper = parted[middle]
    return float(upper if len(values) % 2 else (parted[:middle].max() + upper) / 2)


def relative_sharpness(color: np.ndarray, seen: SeenAgain, exposure: np.ndarray) -> float:
    """Contrast between neighbouring pixels (root mean square of the gradient of grey values) in an image uint8
    [H, W, 3] as a share of what a map shows of it with the image's exposure [3, 2]; 1 where too little is seen by both.
    """
    known = np.zeros(seen.depth.shape, bool)
    known[_SOME] = seen.common_pixels()
    gains = exposure[:, 0].astype(np.float32)
    image = color.astype(np.float32).mean(2) / 255
    shown = np.tensordot(gains, seen.image.clip(0, 1), 1) / np.float32(3)
    ours, theirs = (float(sum(np.square(d)[known].sum() for d in np.gradient(grey))) for grey in (image, shown))
    if known.sum() < ExposureTuning.min_share * known.size / ExposureTuning.stride**2 or theirs <= 0:
        return 1.0
    return float(np.sqrt(ours / theirs))


def without_exposure(color: np.ndarray, exposure: np.ndarray) -> np.ndarray:
    """The colours uint8 [H, W, 3] as they would have been seen with the map's own exposure."""
    return np.clip(exactly_without_exposure(color, exposure) + np.float32(0.5), 0, 255).astype(np.uint8)


def exactly_without_exposure(color: np.ndarray, exposure: np.ndarray) -> np.ndarray:
    """The same neither rounded nor kept within 0 and 255, float32 [H, W, 3]."""
    gain, offset = exposure.astype(np.float32).T
    return (color.astype(np.float32) - np.float32(255) * offset) / gain
