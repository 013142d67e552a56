# SPDX-License-Identifier: Apache-2.0
"""Finds other places where a scan matches as well as at its pose.

Along a plain corridor any place matches, along one with niches a shifted place matches nearly as well as the right one,
and between pillars at equal distances there are places that cannot be told apart. The information of the matches does
not tell: it is that of the place where the alignment ended. So the scan is aligned again from starts along the
direction that its matches tell the least of. If one ends where more points match, that is the place; if one ends
elsewhere with as many, neither is known to be right.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ggslam.localization.scan_alignment import ScanMatch
from ggslam.system.tuning import Tuning
from ggslam.tracking.gicp import AlignmentStatus


class RivalTuning(Tuning):
    """When a scan matches at several places."""

    step_voxels = 2.5
    """Distance between starts in voxels. An alignment converges from half of it."""
    margin = 0.02
    """Difference of the shares of matched points below which two places cannot be told apart."""
    better = 0.012
    """Difference of these shares from which the other place is the better one, beyond chance."""
    far_margin = 0.06
    """Margin for places far off, near the edge of the map in memory."""
    rounds = 4
    """Most times that the search is repeated around a better place."""
    near_steps = 2.5
    """Distance, in steps, up to which a rival means that a direction is not observed. Beyond it, the scene repeats."""


@dataclass(frozen=True)
class Rival:
    """Another place that matches as well.

    Attributes:
        direction: unit vector [3] in the world towards it.
        distance: metres; 0: none was found, but nothing that matches tells of motion along the direction.
        near: whether places between match, too: motion along the direction is not seen.
    """

    direction: np.ndarray
    distance: float
    near: bool

    def __str__(self) -> str:
        along = " ".join(f"{value:.2f}" for value in self.direction)
        if self.near:
            return f"motion along ({along}) is not seen"
        return f"a place {self.distance:.1f} m along ({along}) matches as well"


Aligned = Callable[[np.ndarray], ScanMatch]
Refine = Callable[[ScanMatch], ScanMatch]


def look_around(
    match: ScanMatch,
    aligned: Aligned,
    refine: Refine,
    refine_there: Refine,
    centre: np.ndarray,
    span: float,
    rounds: int = RivalTuning.rounds,
) -> tuple[ScanMatch, Rival | None]:
    """The best match at or along a line through a place, and what rivals it.

    Args:
        match: of the place.
        aligned: aligns from a pose.
        refine: aligns again from a match as long as that moves it.
        refine_there: the same with the map around that place.
        centre: where the scan is believed to be, [3].
        span: metres from there within which places come into question.
        rounds: of going to a better place.
    """
    rival = None
    for _ in range(rounds):
        better, rival = _one_round(match, aligned, refine, refine_there, centre, span)
        if better is None:
            break
        match = better
    return match, rival


def _one_round(
    match: ScanMatch, aligned: Aligned, refine: Refine, refine_there: Refine, centre: np.ndarray, span: float
) -> tuple[ScanMatch | None, Rival | None]:
    step = RivalTuning.step_voxels * match.target.voxel
    better, rival = None, None
    seen = [match.pose[:3, 3]]
    for shift in _shifts(match.pose[:3, 3] - centre, match.weakest, step, span):
        start = match.pose
        start[:3, 3] += shift * match.weakest
        far = abs(shift) > RivalTuning.near_steps * step
        other = aligned(start)
        if not _rivals(other, match, seen, step, RivalTuning.far_margin if far else RivalTuning.margin):
            continue
        other = refine_there(other) if far else refine(other)
        if not _rivals(other, match, seen, step, RivalTuning.margin):
            seen += [other.pose[:3, 3]] if far else []
            continue
        seen.append(other.pose[:3, 3])
        if other.found.overlap > (better or match).found.overlap + (0.0 if better else RivalTuning.better):
            better = other
        elif rival is None:
            away = other.pose[:3, 3] - match.pose[:3, 3]
            distance = float(np.linalg.norm(away))
            rival = Rival(away / distance, distance, distance < RivalTuning.near_steps * step)
    return better, rival


def _rivals(other: ScanMatch, match: ScanMatch, seen: list[np.ndarray], step: float, margin: float) -> bool:
    """Whether a match is as good as one, at a place that has not been seen."""
    if other.found.status is AlignmentStatus.LOST or other.found.overlap < match.found.overlap - margin:
        return False
    return min(float(np.linalg.norm(other.pose[:3, 3] - place)) for place in seen) > step / 2


def _shifts(offset: np.ndarray, direction: np.ndarray, step: float, span: float) -> list[float]:
    """Metres along a direction, nearest first, that lead from an offset to within `span` of zero; those of one step
    always do."""
    steps = np.arange(1, int(2 * span / step) + 2)
    shifts = (steps[:, None] * [step, -step]).ravel()
    within = np.linalg.norm(offset + shifts[:, None] * direction, axis=1) <= span
    return shifts[within | (np.abs(shifts) < 1.5 * step)].tolist()
