# SPDX-License-Identifier: Apache-2.0
"""Small views of frames spread over a recording: what is compared to see whether its streams go on and show a scene."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.sequences.sequence import Sequence

MOST = 24
"""Frames of a recording that are looked at."""
SIZE = (40, 30)
"""Columns and rows of a small view."""
SAME_GREY, EVERYWHERE = 2.0, 98.0
"""Grey levels by which an image differs from itself at most, in this percentile of the pixels, once it was compressed
again."""
LEAST_CONTRAST = 8.0
"""Standard deviation in grey levels."""
OTHER_GREY, OTHER_DEPTH, MOVED = 4.0, 0.04, 0.25
"""Grey levels, and share of the depth, by which this share of the pixels differs once the camera has moved. Noise is
far below: each pixel is the mean of many."""
FEWEST_DEPTHS = 100
"""Pixels with depth in both of two views, or nothing is said of it."""
SAME_NEIGHBOUR = 0.05
"""Share of the depth by which neighbours on a surface differ at most."""
FEWEST_NEIGHBOURS = 200


@dataclass(frozen=True)
class Glance:
    """A frame in small.

    Attributes:
        index: of the frame.
        grey: float32 [30, 40], as stored.
        depth: float32 [30, 40] metres; 0: less than half of the pixels there have any.
        grain: correlation of neighbouring pixels of the whole colour image: 1: smooth, 0: noise; NaN: blank.
        surface: share of neighbouring pixels with depth that are about as far as one another; NaN: too few.
    """

    index: int
    grey: np.ndarray
    depth: np.ndarray
    grain: float
    surface: float

    @property
    def blank(self) -> bool:
        """Whether its colour image shows one colour and nothing else."""
        return bool(np.ptp(self.grey) < SAME_GREY)

    def same_color(self, other: Glance) -> bool:
        """Whether both hold one colour image that shows something: bare walls look alike wherever one stands."""
        change = np.abs(self.grey - other.grey)
        return bool(self.grey.std() > LEAST_CONTRAST and np.percentile(change, EVERYWHERE) < SAME_GREY)

    def same_depth(self, other: Glance) -> bool:
        """Whether both hold one depth image: no sensor measures the same twice."""
        return np.array_equal(self.depth, other.depth)

    def color_moved(self, other: Glance) -> bool:
        """Whether the colour images show other things, exposure forgiven."""
        if self.blank or other.blank:
            return False
        here, there = ((view.grey - view.grey.mean()) / view.grey.std() for view in (self, other))
        level = OTHER_GREY / min(float(self.grey.std()), float(other.grey.std()))
        return bool((np.abs(here - there) > max(level, 0.1)).mean() > MOVED)

    def depth_moved(self, other: Glance) -> bool:
        """Whether the depth images show other things."""
        known = (self.depth > 0) & (other.depth > 0)
        if known.sum() < FEWEST_DEPTHS:
            return False
        change = np.abs(self.depth - other.depth)[known] / np.minimum(self.depth, other.depth)[known]
        return bool((change > OTHER_DEPTH).mean() > MOVED)


def glance_at(frame: Frame) -> Glance:
    """A frame in small."""
    grey = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.float32)
    share = cv2.resize((frame.depth > 0).astype(np.float32), SIZE, interpolation=cv2.INTER_AREA)
    depth = cv2.resize(frame.depth, SIZE, interpolation=cv2.INTER_AREA)
    depth = np.where(share > 0.5, depth / np.maximum(share, 1e-6), np.float32(0))
    small = cv2.resize(grey, SIZE, interpolation=cv2.INTER_AREA)
    return Glance(frame.index, small, depth, _grain(grey), _surface(frame.depth))


def look_over(sequence: Sequence) -> list[Glance]:
    """Frames spread over a recording; damaged ones are left out."""
    chosen = np.unique(np.linspace(0, len(sequence) - 1, min(MOST, len(sequence))).round().astype(int))
    return [found for k in chosen.tolist() if (found := glance_of(sequence, k)) is not None]


def glance_of(sequence: Sequence, index: int) -> Glance | None:
    """Frame `index` in small; None: it is damaged."""
    try:
        return glance_at(sequence.frame(index, masks=False))
    except SequenceError:
        return None


def _grain(grey: np.ndarray) -> float:
    rows = grey[::2] - grey.mean()
    power = float(np.square(rows).mean())
    return float((rows[:, 1:] * rows[:, :-1]).mean()) / power if power > 1e-3 else float("nan")


def _surface(depth: np.ndarray) -> float:
    left, right = depth[::2, :-1], depth[::2, 1:]
    known = (left > 0) & (right > 0)
    left, right = left[known], right[known]
    if len(left) < FEWEST_NEIGHBOURS:
        return float("nan")
    return float((np.abs(left - right) < SAME_NEIGHBOUR * np.minimum(left, right)).mean())
