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
SAME_VIEW = 3.0
"""The same, of images of other compression: once a stream hangs on both sides, views that are so near are one."""
SAME_DEPTH, MOST_DEPTHS, SAME_JUMPS = 0.004, 0.02, 0.02
"""Shares of the depth by which half of the pixels, nine in ten, and half of those at jumps of depth differ at most if a
depth image comes again with fresh noise. A camera at rest has 0.001 and 0.004, a frame of slow motion 0.008."""
JUMP, FEWEST_JUMPS = 0.1, 8
"""Share of the depth by which neighbours in a small view differ at a jump, and how many there have to be across and
down: along walls and floors one may move far and measure the same."""
OTHER_EDGES = 0.3
"""Correlation of edges below which two colour images show other things, whatever the light."""
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

    def like_color(self, other: Glance) -> bool:
        """Whether both may hold one colour image, compressed otherwise."""
        return bool(np.percentile(np.abs(self.grey - other.grey), EVERYWHERE) < SAME_VIEW)

    def same_depth(self, other: Glance) -> bool:
        """Whether both hold one depth image: bit by bit, or but for noise, where jumps of depth would move."""
        return np.array_equal(self.depth, other.depth) or self._depth_again(other)

    def _depth_again(self, other: Glance) -> bool:
        known = (self.depth > 0) & (other.depth > 0)
        if known.sum() < FEWEST_DEPTHS:
            return False
        change = np.abs(self.depth - other.depth) / np.maximum(np.minimum(self.depth, other.depth), 1e-6)
        if np.median(change[known]) > SAME_DEPTH or np.percentile(change[known], 90) > MOST_DEPTHS:
            return False
        jumps = [at & known for at in _jumps(self.depth)]
        return all(at.sum() >= FEWEST_JUMPS and np.median(change[at]) < SAME_JUMPS for at in jumps)

    def color_moved_on(self, other: Glance) -> bool:
        """Whether the colour images show other things beside what `same_depth` calls the same: a lamp that is switched
        on before a camera at rest is none."""
        if not self.color_moved(other):
            return False
        if np.array_equal(self.depth, other.depth):
            return True
        here, there = _edges(self.grey), _edges(other.grey)
        return float((here * there).mean()) < OTHER_EDGES

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


def _jumps(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels beside a jump of depth to the right of them, and below, bool [H, W] each."""
    found = []
    for axis in (1, 0):
        there = np.roll(depth, -1, axis)
        nearer = np.minimum(depth, there)
        at = (nearer > 0) & (np.abs(depth - there) > JUMP * nearer)
        (at[:, -1:] if axis else at[-1:])[:] = False
        found.append(at)
    return found[0], found[1]


def _edges(grey: np.ndarray) -> np.ndarray:
    """Strength of edges, of mean 0 and deviation 1."""
    down, right = np.gradient(grey)
    strength = np.hypot(down, right)
    return (strength - strength.mean()) / (strength.std() + np.float32(1e-6))


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
