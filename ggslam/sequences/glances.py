# SPDX-License-Identifier: Apache-2.0
"""Small views of frames spread over a recording: what is compared to see whether its streams go on and show a scene."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.sequences.sequence import Sequence
from ggslam.system.tuning import Tuning


class GlanceTuning(Tuning):
    """When small views of two frames show the same, and when they do not."""

    frames = 24
    """Frames spread over a recording."""
    size = (40, 30)
    """Columns and rows of a small view."""
    same_grey = 2.0
    """Largest difference of an image compressed twice, in grey levels."""
    same_percentile = 98.0
    """Percentile of the pixels that this is said of."""
    like_grey = 3.0
    """Largest difference of two images that may be the same, compressed differently, in grey levels."""
    same_depth = 0.004
    """Largest median difference of a depth image repeated with fresh noise, as a share of the depth. A camera at rest
    has 0.001, slow motion 0.008."""
    most_same_depth = 0.02
    """Largest 90th percentile of that difference. A camera at rest has 0.004."""
    same_jumps = 0.02
    """Largest median of that difference at jumps of depth."""
    jump = 0.1
    """Difference of neighbours at a jump of depth, as a share of the depth."""
    min_jumps = 8
    """Fewest jumps across and down: along walls and floors, depth stays the same while a camera moves."""
    other_edges = 0.3
    """Correlation of edges below which two colour images show different things in any light."""
    min_contrast = 8.0
    """Smallest standard deviation of an image that shows something, in grey levels."""
    other_grey = 4.0
    """Difference of a pixel once the camera has moved, in grey levels."""
    other_depth = 0.04
    """Difference of a pixel once the camera has moved, as a share of the depth."""
    moved = 0.25
    """Share of the pixels that differ once the camera has moved."""
    min_depths = 100
    """Fewest pixels with depth in both of two views."""
    same_neighbour = 0.05
    """Largest difference of neighbours on one surface, as a share of the depth."""
    min_neighbours = 200
    """Fewest neighbours with depth."""


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
        return bool(np.ptp(self.grey) < GlanceTuning.same_grey)

    def same_color(self, other: Glance) -> bool:
        """Whether both hold one colour image that shows something: bare walls look alike wherever one stands."""
        change = np.abs(self.grey - other.grey)
        return bool(
            self.grey.std() > GlanceTuning.min_contrast
            and np.percentile(change, GlanceTuning.same_percentile) < GlanceTuning.same_grey
        )

    def like_color(self, other: Glance) -> bool:
        """Whether both may hold one colour image, compressed otherwise."""
        return bool(
            np.percentile(np.abs(self.grey - other.grey), GlanceTuning.same_percentile) < GlanceTuning.like_grey
        )

    def same_depth(self, other: Glance) -> bool:
        """Whether both hold one depth image: bit by bit, or but for noise, where jumps of depth would move."""
        return np.array_equal(self.depth, other.depth) or self._depth_again(other)

    def _depth_again(self, other: Glance) -> bool:
        known = (self.depth > 0) & (other.depth > 0)
        if known.sum() < GlanceTuning.min_depths:
            return False
        change = np.abs(self.depth - other.depth) / np.maximum(np.minimum(self.depth, other.depth), 1e-6)
        if (
            np.median(change[known]) > GlanceTuning.same_depth
            or np.percentile(change[known], 90) > GlanceTuning.most_same_depth
        ):
            return False
        jumps = [at & known for at in _jumps(self.depth)]
        return all(
            at.sum() >= GlanceTuning.min_jumps and np.median(change[at]) < GlanceTuning.same_jumps for at in jumps
        )

    def color_moved_on(self, other: Glance) -> bool:
        """Whether the colour images show other things beside what `same_depth` calls the same: a lamp that is switched
        on before a camera at rest is none."""
        if not self.color_moved(other):
            return False
        if np.array_equal(self.depth, other.depth):
            return True
        here, there = _edges(self.grey), _edges(other.grey)
        return float((here * there).mean()) < GlanceTuning.other_edges

    def color_moved(self, other: Glance) -> bool:
        """Whether the colour images show other things, exposure forgiven."""
        if self.blank or other.blank:
            return False
        here, there = ((view.grey - view.grey.mean()) / view.grey.std() for view in (self, other))
        level = GlanceTuning.other_grey / min(float(self.grey.std()), float(other.grey.std()))
        return bool((np.abs(here - there) > max(level, 0.1)).mean() > GlanceTuning.moved)

    def depth_moved(self, other: Glance) -> bool:
        """Whether the depth images show other things."""
        known = (self.depth > 0) & (other.depth > 0)
        if known.sum() < GlanceTuning.min_depths:
            return False
        change = np.abs(self.depth - other.depth)[known] / np.minimum(self.depth, other.depth)[known]
        return bool((change > GlanceTuning.other_depth).mean() > GlanceTuning.moved)


def glance_at(frame: Frame) -> Glance:
    """A frame in small."""
    grey = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.float32)
    share = cv2.resize((frame.depth > 0).astype(np.float32), GlanceTuning.size, interpolation=cv2.INTER_AREA)
    depth = cv2.resize(frame.depth, GlanceTuning.size, interpolation=cv2.INTER_AREA)
    depth = np.where(share > 0.5, depth / np.maximum(share, 1e-6), np.float32(0))
    small = cv2.resize(grey, GlanceTuning.size, interpolation=cv2.INTER_AREA)
    return Glance(frame.index, small, depth, _grain(grey), _surface(frame.depth))


def look_over(sequence: Sequence) -> list[Glance]:
    """Frames spread over a recording; damaged ones are left out."""
    chosen = np.unique(np.linspace(0, len(sequence) - 1, min(GlanceTuning.frames, len(sequence))).round().astype(int))
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
        at = (nearer > 0) & (np.abs(depth - there) > GlanceTuning.jump * nearer)
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
    if len(left) < GlanceTuning.min_neighbours:
        return float("nan")
    return float((np.abs(left - right) < GlanceTuning.same_neighbour * np.minimum(left, right)).mean())
