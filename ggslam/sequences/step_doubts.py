# SPDX-License-Identifier: Apache-2.0
"""Whether colour and depth are of the same moment: outlines of a depth image are laid on the edges of the colour image
of its own frame and of those before and after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.sequences.alignment import FEWEST_OUTLINES, edges_of, outlines_of
from ggslam.sequences.sequence import Sequence

REACH = 2
"""Frames before and after."""
PLACES = 4
"""Where in a recording one looks."""
LEAST_GAIN, LEAST_SHARE = 0.05, 0.1
"""By how much another frame's colour must fit better, in standard deviations of the edge images, and as a share of how
well that fits."""


@dataclass(frozen=True)
class StepDoubt:
    """Where depth fits colour in time.

    Attributes:
        behind: frames that depth is behind colour; negative: ahead of it. Either may be the largest looked at.
        strength: of the colour's edges under the outlines of depth as they stand, in standard deviations.
        best: the same of the colour of the frame that fits best.
    """

    behind: int
    strength: float
    best: float

    @property
    def wrong(self) -> bool:
        """Whether another frame's colour fits clearly better."""
        gain = self.best - self.strength
        return self.behind != 0 and gain > max(LEAST_GAIN, LEAST_SHARE * self.best)


def doubt_steps(sequence: Sequence) -> StepDoubt | None:
    """Compares depth with the colour of neighbouring frames; None if too few outlines are seen or frames are few."""
    if len(sequence) < 2 * REACH + 1:
        return None
    sums, used = np.zeros(2 * REACH + 1), 0
    for middle in np.unique(np.linspace(REACH, len(sequence) - 1 - REACH, PLACES).round().astype(int)):
        try:
            frames = [sequence.frame(int(k), masks=False) for k in range(middle - REACH, middle + REACH + 1)]
        except SequenceError:
            continue
        found = _strengths(frames)
        if found is not None:
            sums, used = sums + found, used + 1
    if used < 2:
        return None
    best = int(sums.argmax())
    return StepDoubt(REACH - best, float(sums[REACH]) / used, float(sums[best]) / used)


def _strengths(frames: list[Frame]) -> np.ndarray | None:
    """Mean strength of the edges of each frame's colour under the outlines of the middle one's depth."""
    outlines = outlines_of(frames[REACH].depth)
    if outlines.sum() < FEWEST_OUTLINES * outlines.size:
        return None
    at = outlines > 0
    return np.array([edges_of(frame.color)[at].mean() for frame in frames])
