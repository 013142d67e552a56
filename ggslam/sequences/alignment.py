# SPDX-License-Identifier: Apache-2.0
"""Whether depth lies on colour: outlines of near things in the depth images are laid over the edges of the colour
images, shifted and scaled, to see where they fit best."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.scene.frame import Frame
from ggslam.system.tuning import Tuning


class AlignmentTuning(Tuning):
    """How depth is laid over colour, and when a displacement is reported."""

    width = 320
    """Columns of the images that are compared, about."""
    jump = 1.06
    """A surface lies behind another one if it is farther by this factor."""
    max_shift = 0.06
    """Largest displacement that is tried, as a share of the image's width."""
    min_outlines = 0.002
    """Fewest outlines in a frame that counts, as a share of its pixels."""
    min_frames = 3
    """Fewest frames that count."""
    scales = (0.86, 0.9, 0.93, 0.96, 0.98, 1.0, 1.02, 1.04, 1.07, 1.1, 1.14)
    """Factors by which depth is enlarged."""
    warn_off = 0.012
    """Displacement above which a warning is given, as a share of the image's width."""
    warn_gain = 0.4
    """Gain above which a warning is given, in standard deviations of the edge image."""
    warn_gain_share = 0.3
    """The same as a share of the strength without displacement."""


@dataclass(frozen=True)
class Alignment:
    """Where the outlines of depth fit the edges of colour best.

    Attributes:
        shift: (columns, rows) that depth lies to the left of and above its place in colour, in shares of the width.
        scale: by which depth is to be enlarged about the centre of the image to fit.
        gain: how much better it fits there than as it is: strength of the colour edges under the outlines, in standard
            deviations of the edge image.
        strength: the same strength as it is.
    """

    shift: tuple[float, float]
    scale: float
    gain: float
    strength: float

    @property
    def off(self) -> float:
        """Largest displacement in the image, as a share of its width."""
        return float(np.hypot(*self.shift)) + 0.5 * abs(self.scale - 1)

    @property
    def doubtful(self) -> bool:
        """Whether depth fits clearly better somewhere else."""
        return (
            self.off > AlignmentTuning.warn_off
            and self.gain > AlignmentTuning.warn_gain
            and self.gain > AlignmentTuning.warn_gain_share * self.strength
        )


def measure_alignment(frames: list[Frame]) -> Alignment | None:
    """Compares colour and depth of some frames; None if too few of them show enough outlines."""
    width = _small_size(frames[0].depth)[0] if frames else AlignmentTuning.width
    reach = max(2, round(AlignmentTuning.max_shift * width))
    surfaces, weight = np.zeros((len(AlignmentTuning.scales), 2 * reach + 1, 2 * reach + 1)), 0
    for frame in frames:
        outlines, edges = outlines_of(frame.depth), edges_of(frame.color)
        if outlines.sum() < AlignmentTuning.min_outlines * outlines.size:
            continue
        # Each frame counts alike: one with a picture on the wall has many edges.
        found = np.stack([_correlation(outlines, edges, scale, reach) for scale in AlignmentTuning.scales])
        surfaces += found / outlines.sum()
        weight += 1
    if weight < AlignmentTuning.min_frames:
        return None
    surfaces /= weight
    at_rest = float(surfaces[AlignmentTuning.scales.index(1.0), reach, reach])
    scale, row, column = (int(i) for i in np.unravel_index(int(surfaces.argmax()), surfaces.shape))
    shift = ((column - reach) / width, (row - reach) / width)
    return Alignment(shift, AlignmentTuning.scales[scale], float(surfaces[scale, row, column]) - at_rest, at_rest)


def _small_size(image: np.ndarray) -> tuple[int, int]:
    height, width = image.shape[:2]
    factor = min(1.0, AlignmentTuning.width / width)
    return max(1, round(width * factor)), max(1, round(height * factor))


def outlines_of(depth: np.ndarray) -> np.ndarray:
    """Pixels of surfaces at whose border farther ones were measured too, float32 [H, W] 0 or 1."""
    small = cv2.resize(depth, _small_size(depth), interpolation=cv2.INTER_NEAREST)
    kernel = np.ones((5, 5), np.uint8)
    known = small > 0
    far = cv2.dilate(small, kernel)
    near = cv2.erode(np.where(known, small, np.float32(1e9)), kernel)
    outlines = known & (far > AlignmentTuning.jump * small) & (small < 1.02 * near)
    # The outermost of them: those that touch the farther surface.
    touching = cv2.dilate(small, np.ones((3, 3), np.uint8)) > AlignmentTuning.jump * small
    outlines &= touching
    outlines[:3], outlines[-3:], outlines[:, :3], outlines[:, -3:] = False, False, False, False
    return outlines.astype(np.float32)


def edges_of(color: np.ndarray) -> np.ndarray:
    """Strength of edges, float32 [H, W], of mean 0 and deviation 1."""
    grey = cv2.cvtColor(cv2.resize(color, _small_size(color), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.8)
    strength = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    strength = cv2.GaussianBlur(np.sqrt(strength), (0, 0), 1.0)  # the root: weak edges count too
    return (strength - strength.mean()) / (strength.std() + np.float32(1e-6))


def _correlation(outlines: np.ndarray, edges: np.ndarray, scale: float, reach: int) -> np.ndarray:
    """Edges under the outlines enlarged by `scale` and shifted by up to `reach`: float [2 reach + 1, 2 reach + 1]."""
    height, width = edges.shape
    rows, columns = np.nonzero(outlines)
    v = np.rint((rows - (height - 1) / 2) * scale + (height - 1) / 2).astype(int)
    u = np.rint((columns - (width - 1) / 2) * scale + (width - 1) / 2).astype(int)
    padded = cv2.copyMakeBorder(edges, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0.0)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    drawn = np.zeros((height, width), np.float32)
    np.add.at(drawn, (v[inside], u[inside]), 1.0)
    return cv2.matchTemplate(padded, drawn, cv2.TM_CCORR)
