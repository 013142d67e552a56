# SPDX-License-Identifier: Apache-2.0
"""Locates laser scans in the part of the map around the sensor."""

from __future__ import annotations

from dataclasses import field

import numpy as np

from ggslam.localization.localizer import FrontEndResult, LocalizationStatus
from ggslam.localization.rivals import Aligned, Refine, Rival, look_around
from ggslam.localization.scan_alignment import ScanAligner, ScanMatch, ScanSource, SearchSettings
from ggslam.localization.scan_look_up import ScanLookUp
from ggslam.localization.surface import Surface
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import inverse, orthonormalize
from ggslam.system.settings import setting, settings_class, tuning_class
from ggslam.tracking.gicp import AlignmentResult, AlignmentStatus, GicpTarget
from ggslam.tracking.scan_points import ScanSettings
from ggslam.tracking.settings import AlignSettings


@tuning_class(frozen=True)
class ScanTrackerTuning:
    """Numbers of locating scans."""

    min_counted: int = setting(200, 6, 10**6)
    """A scan is lost if the map can contain fewer of its points."""
    max_skipped = 7
    """Most lost scans between two that are looked up."""
    doubtful = 2.5
    """Visibility of a direction, in multiples of the limit of degeneracy, below which rivals are searched although the
    motion is known. Noise and voxels reach it in a plain corridor."""


@settings_class(frozen=True)
class ScanTrackerSettings(ScanTrackerTuning):
    """How laser scans are located."""

    scan: ScanSettings = field(default_factory=ScanSettings)
    """Which of their points are used."""
    sigma: float = setting(0.02, 1e-4, 10, "m")
    """Standard deviation of a range."""
    align: AlignSettings = field(default_factory=lambda: AlignSettings(min_normal_dot=0.0, coarse_iterations=8))
    """The points' "normals" point to the sensor, hence the cosine."""
    search: SearchSettings = field(default_factory=SearchSettings)
    """How a scan is located whose start is far off."""
    min_overlap: float = setting(0.5, 0, 0.9)
    """A scan is lost if less than this share of the points that the map can contain matches it."""


class ScanTracker:
    """Locates laser scans, float [n, 3] in metres in the sensor's frame.

    Args:
        settings: see `ScanTrackerSettings`.
        context: threads.
        T_world_sensor: pose of the first scan; None: it is looked up.
        places: where lost scans are looked up; None: they are not.
    """

    def __init__(
        self, settings: ScanTrackerSettings, context: NativeContext, T_world_sensor: np.ndarray | None,
        places: ScanLookUp | None = None,
    ) -> None:  # fmt: skip
        self.settings = settings
        self.aligner = ScanAligner(settings.scan, settings.align, settings.search, settings.sigma, context)
        self._places = places
        self._pose = np.full((4, 4), np.nan) if T_world_sensor is None else np.array(T_world_sensor, float)
        self._velocity = np.eye(4)
        self._located = self._passes = self._wait = 0

    @property
    def _sure(self) -> bool:
        """Whether the motion is known: from then on it speaks for a pose, too."""
        return self._located >= 2

    def track(self, item: np.ndarray, surface: Surface, target: GicpTarget) -> FrontEndResult:
        """See `FrontEnd`. Tries constant velocity, and if that does not convince, standing still, then a search around
        it. As long as the motion is not known, nothing but the match speaks for a pose: it is judged more strictly."""
        source = self.aligner.source(item)
        best: ScanMatch | None = None
        for guess in (self._pose @ self._velocity, self._pose):
            match = self.aligner.fine(source, surface, target, guess)
            if best is None or _is_better(match, best):
                best = match
            if self._is_right(best):
                return self._outcome(*self._beside_rivals(source, surface, target, best))
        assert best is not None
        guess, around = self._pose @ self._velocity, not self._convinces(best)
        found = self.aligner.search(source, surface, target, guess, self.settings.min_overlap, around)
        if found is None:
            return self._outcome(best)
        return self._outcome(*self._beside_rivals(source, surface, surface.target or target, found))

    def _beside_rivals(
        self, source: ScanSource, surface: Surface, target: GicpTarget, match: ScanMatch
    ) -> tuple[ScanMatch, Rival | None]:
        """A match that is right, or a better one beside it; and what rivals it. Once the motion is known, it says where
        along the direction the sensor is; that nothing else does is told all the same."""
        sure, centre = self._sure, (self._pose @ self._velocity)[:3, 3]
        if sure and match.found.visibility[0] > ScanTrackerTuning.doubtful * self.settings.align.degenerate_below:
            return match, None
        if not sure:
            match = self.aligner.at_place(source, surface, target, match.pose)
        here = match.pose[:3, 3]
        steps = self._steps(source, surface, target, here)
        if sure:
            return match, look_around(match, *steps, here, 0.0, 1)[1]
        best, rival = look_around(match, *steps, centre, self.aligner.span)
        if best is not match:
            if not self._is_right(best):
                return match, rival
            best = self.aligner.at_place(source, surface, target, best.pose)
        if rival is None and not self.aligner.is_told(best):
            rival = Rival(best.weakest, 0.0, near=True)
        return best, rival

    def _steps(
        self, source: ScanSource, surface: Surface, target: GicpTarget, here: np.ndarray
    ) -> tuple[Aligned, Refine, Refine]:
        """What `look_around` aligns with; the surface stays at `here` [3]."""

        def align_at(start: np.ndarray) -> ScanMatch:
            return self.aligner.fine(source, surface, surface.target or target, start)

        def refine(other: ScanMatch) -> ScanMatch:
            return self.aligner.refine(source, surface, surface.target or target, other)

        def refine_there(other: ScanMatch) -> ScanMatch:
            found = self.aligner.at_place(source, surface, target, other.pose)
            surface.move_to(here)
            return found

        return align_at, refine, refine_there

    def look_up(self, item: np.ndarray, surface: Surface) -> FrontEndResult | None:
        """See `FrontEnd`. After each scan that was not found, more are skipped, at most
        `ScanTrackerTuning.max_skipped`."""
        if self._places is None:
            return None
        if self._passes:
            self._passes -= 1
            return None
        source = self.aligner.source(item)

        def align_at(guess: np.ndarray) -> AlignmentResult:
            assert surface.target is not None
            match = self.aligner.fine(source, surface, surface.target, guess)
            return self.aligner.refine(source, surface, surface.target, match).found

        found, reason = self._places.find(item, surface, align_at)
        if found is None:
            self._passes = self._wait
            self._wait = min(2 * self._wait + 1, ScanTrackerTuning.max_skipped)
            return FrontEndResult(self._pose.copy(), LocalizationStatus.LOST, 0.0, 0.0, reason)
        self._passes = self._wait = 0
        self._velocity, self._located = np.eye(4), 1
        self._pose = orthonormalize(found.alignment.T_world_camera)
        alignment = found.alignment
        return FrontEndResult(self._pose.copy(), LocalizationStatus.FOUND, alignment.overlap, alignment.rmse, reason)

    def _is_right(self, match: ScanMatch) -> bool:
        return match.counted >= self.settings.min_counted and self.aligner.is_right(match, self.settings.min_overlap)

    def _convinces(self, match: ScanMatch) -> bool:
        if not self._sure or match.counted < self.settings.min_counted:
            return self._is_right(match)
        enough = match.found.overlap >= self.settings.min_overlap
        return enough and match.found.status is not AlignmentStatus.LOST

    def _outcome(self, match: ScanMatch, rival: Rival | None = None) -> FrontEndResult:
        found = match.found
        if not self._convinces(match):
            self._velocity, self._located = np.eye(4), 0
            pose, status = self._pose.copy(), LocalizationStatus.LOST
            return FrontEndResult(pose, status, found.overlap, found.rmse, self._why_lost(match), match.beyond)
        T = orthonormalize(found.T_world_camera)
        self._velocity = inverse(self._pose) @ T if self._located else np.eye(4)
        self._pose = T
        if rival is None or self._located == 0:  # where along the direction the first one was says nothing of motion
            self._located += 1
        status = LocalizationStatus.DEGENERATE if found.degenerate or rival is not None else LocalizationStatus.OK
        return FrontEndResult(T.copy(), status, found.overlap, found.rmse, str(rival or ""), match.beyond)

    def _why_lost(self, match: ScanMatch) -> str:
        overlap, needed = match.found.overlap, self.settings.min_overlap
        if match.counted < self.settings.min_counted:
            return (
                f"only {match.counted} of {match.total} points lie where the map in memory reaches, "
                f"{self.settings.min_counted} needed"
            )
        text = f"{overlap:.0%} of {match.counted} points match the map, {needed:.0%} needed"
        if overlap < needed:
            return text
        return f"{text}, but only {match.structure:.0%} of those that tell the place, from every start"


def _is_better(match: ScanMatch, other: ScanMatch) -> bool:
    return match.found.status is not AlignmentStatus.LOST and match.found.overlap > other.found.overlap
