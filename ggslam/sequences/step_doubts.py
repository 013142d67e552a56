# SPDX-License-Identifier: Apache-2.0
"""Whether colour and depth are of the same moment: outlines of a depth image are laid on the edges of the colour image
of its own frame and of those before and after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame
from ggslam.sequences.alignment import AlignmentTuning, edges_of, outlines_of
from ggslam.sequences.sequence import Sequence
from ggslam.system.tuning import Tuning


class StepTuning(Tuning):
    """When depth is said to be some frames late."""

    reach = 2
    """Frames before and after."""
    places = 6
    """Frames spread over the recording."""
    min_places = 3
    """Fewest of them with outlines."""
    min_gain = 0.05
    """Smallest gain, in standard deviations of the edge image, also without any one of the places."""
    min_gain_share = 0.1
    """The same as a share of the best strength."""


@dataclass(frozen=True)
class StepDoubt:
    """Where depth fits colour in time.

    Attributes:
        behind: frames that depth is behind colour; negative: ahead of it. Either may be the largest looked at.
        strength: of the colour's edges under the outlines of depth as they stand, in standard deviations.
        best: the same of the colour of the frame that fits best.
        agreed: whether that frame fits clearly better wherever one looks, any one place left out.
    """

    behind: int
    strength: float
    best: float
    agreed: bool = True

    @property
    def wrong(self) -> bool:
        """Whether another frame's colour fits clearly better."""
        return self.agreed and self.behind != 0 and _is_clear(self.strength, self.best)


def _is_clear(strength: float, best: float) -> bool:
    return best - strength > max(StepTuning.min_gain, StepTuning.min_gain_share * best)


def doubt_steps(sequence: Sequence) -> StepDoubt | None:
    """Compares depth with the colour of neighbouring frames; None if too few outlines are seen or frames are few."""
    if len(sequence) < 2 * StepTuning.reach + 1:
        return None
    found = []
    for middle in np.unique(
        np.linspace(StepTuning.reach, len(sequence) - 1 - StepTuning.reach, StepTuning.places).round().astype(int)
    ):
        try:
            frames = [
                sequence.frame(int(k), masks=False)
                for k in range(middle - StepTuning.reach, middle + StepTuning.reach + 1)
            ]
        except SequenceError:
            continue
        strengths = _strengths(frames)
        found += [] if strengths is None else [strengths]
    if len(found) < StepTuning.min_places:
        return None
    places = np.stack(found)
    mean, others = places.mean(0), (places.sum(0) - places) / (len(places) - 1)
    best = int(mean.argmax())
    agreed = all(_is_clear(float(rest[StepTuning.reach]), float(rest[best])) for rest in others)
    return StepDoubt(StepTuning.reach - best, float(mean[StepTuning.reach]), float(mean[best]), agreed)


def _strengths(frames: list[Frame]) -> np.ndarray | None:
    """Mean strength of the edges of each frame's colour under the outlines of the middle one's depth."""
    outlines = outlines_of(frames[StepTuning.reach].depth)
    if outlines.sum() < AlignmentTuning.min_outlines * outlines.size:
        return None
    at = outlines > 0
    return np.array([edges_of(frame.color)[at].mean() for frame in frames])
