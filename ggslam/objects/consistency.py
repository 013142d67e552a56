# SPDX-License-Identifier: Apache-2.0
"""Whether the ids of a recording's masks mean the same object in every frame."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from ggslam.objects.overlap import SegmentOverlap
from ggslam.system.array_forms import IdImage
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class ConsistencyTuning(Tuning):
    """When the ids of masks mean the same in all frames."""

    min_pixels = 20
    """Fewest pixels of a segment that counts."""
    min_change = 0.02
    """Smallest share of pixels whose label changes; less proves nothing."""
    agree = 0.9
    """Agreement from which ids are consistent."""
    disagree = 0.6
    """Agreement below which they are not."""


@savable()
class ConsistencyJudge:
    """Compares the masks' ids with those of the map, keyframe by keyframe.

    Consistent ids agree with the map about as well as the best one-to-one renaming of them would. The share is taken
    both of pixels and of segments, the smaller counts: floor and wall keep their ids in many a mask whose small
    segments do not. Keyframes in which hardly a label changed prove nothing, a resting camera's segments may come in
    the same order again.

    Attributes:
        consistent: the verdict; None: not settled. True may be taken back, False is final.
    """

    consistent: bool | None
    _agreement: list[float]
    _previous: IdImage | None

    def __init__(self) -> None:
        self.consistent = None
        self._agreement = []
        self._previous = None

    def observe(self, segments: np.ndarray, overlap: SegmentOverlap) -> bool | None:
        """Takes one keyframe into account; returns the verdict.

        Args:
            segments: uint16 [H, W], the mask as stored.
            overlap: of this mask with the map.
        """
        if self.consistent is False or not self._has_changed(segments):
            return self.consistent
        agreement = agreement_of(overlap)
        if agreement is not None:
            self._agreement = [*self._agreement[-2:], agreement]
            self._settle()
        return self.consistent

    def _has_changed(self, segments: np.ndarray) -> bool:
        previous, self._previous = self._previous, segments
        if previous is None or previous.shape != segments.shape:
            return True
        return float((previous != segments).mean()) >= ConsistencyTuning.min_change

    def _settle(self) -> None:
        recent = self._agreement
        if len(recent) >= 2 and min(recent[-2:]) >= ConsistencyTuning.agree:
            self.consistent = True
        elif len(recent) >= 2 and max(recent[-2:]) < ConsistencyTuning.disagree:
            self.consistent = False
        elif len(recent) >= 3 and self.consistent is None:
            self.consistent = sum(recent) / len(recent) >= (ConsistencyTuning.agree + ConsistencyTuning.disagree) / 2


def agreement_of(overlap: SegmentOverlap) -> float | None:
    """How well ids agree with the map's, 0 to 1 = as well as their best renaming; None: nothing to compare."""
    shared = overlap.shared
    seen = shared.sum(1) >= ConsistencyTuning.min_pixels
    if not seen.any():
        return None
    equal = overlap.segments[:, None] == overlap.objects[None, :]
    rows, columns = linear_sum_assignment(-shared)
    best = shared[rows, columns].sum()
    pixels = shared[equal].sum() / max(best, 1)
    own = (shared * equal).sum(1)[seen]
    segments = float((own >= 0.5 * shared.max(1)[seen]).mean())
    return float(min(pixels, segments))
