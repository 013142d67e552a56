# SPDX-License-Identifier: Apache-2.0
"""Locates laser scans in the surface that the map shows around the sensor."""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from ggslam.localization.localizer import ANY_NORMAL, FrontEndResult, LocalizationStatus
from ggslam.localization.scan_look_up import ScanLookUp
from ggslam.localization.surface import Surface
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import inverse, orthonormalize
from ggslam.system.settings import setting, settings_class
from ggslam.tracking.gicp import AlignmentResult, AlignmentStatus, GicpTarget, align
from ggslam.tracking.scan_points import ScanSettings, scan_points
from ggslam.tracking.settings import AlignSettings, DepthNoise

MOST_PASSED = 7
"""Lost scans between two that are looked up, at most."""


@settings_class(frozen=True)
class ScanTrackerSettings:
    """How scans are located."""

    scan: ScanSettings = field(default_factory=ScanSettings)
    """Which of their points are used."""
    sigma: float = setting(0.02, 1e-4, 10, "m")
    """Standard deviation of a range."""
    align: AlignSettings = field(default_factory=lambda: AlignSettings(min_normal_dot=0.0, coarse_iterations=8))
    """The points' "normals" point to the sensor, hence the cosine."""
    min_overlap: float = setting(0.5, 0, 0.9)
    """Under this share of points that match, the scan is lost."""


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
        self._context, self._places = context, places
        self._pose = np.full((4, 4), np.nan) if T_world_sensor is None else np.array(T_world_sensor, float)
        self._velocity = np.eye(4)
        self._passes, self._wait = 0, 0

    def track(self, item: np.ndarray, surface: Surface, target: GicpTarget) -> FrontEndResult:
        """See `FrontEnd`. Tries constant velocity, and if that does not convince, standing still."""
        best: AlignmentResult | None = None
        source = scan_points(item, self.settings.scan)
        settings = self._align_settings(surface)
        noise = DepthNoise(self.settings.sigma, 0.0)
        for guess in (self._pose @ self._velocity, self._pose):
            found = align(source, target, guess, settings, noise, self._context)
            if best is None or (found.status is not AlignmentStatus.LOST and found.overlap > best.overlap):
                best = found
            if self._convinces(best):
                break
        assert best is not None
        return self._outcome(best, len(source))

    def look_up(self, item: np.ndarray, surface: Surface) -> FrontEndResult | None:
        """See `FrontEnd`. After a scan was not found, ever more are passed over, `MOST_PASSED` at most."""
        if self._places is None:
            return None
        if self._passes:
            self._passes -= 1
            return None
        source, settings = scan_points(item, self.settings.scan), self._align_settings(surface)
        noise = DepthNoise(self.settings.sigma, 0.0)

        def align_at(guess: np.ndarray) -> AlignmentResult:
            assert surface.target is not None
            return align(source, surface.target, guess, settings, noise, self._context)

        found, reason = self._places.find(item, surface, align_at)
        if found is None:
            self._passes = self._wait
            self._wait = min(2 * self._wait + 1, MOST_PASSED)
            return FrontEndResult(self._pose.copy(), LocalizationStatus.LOST, 0.0, 0.0, reason)
        self._passes = self._wait = 0
        self._velocity, self._pose = np.eye(4), orthonormalize(found.alignment.T_world_camera)
        alignment = found.alignment
        return FrontEndResult(self._pose.copy(), LocalizationStatus.FOUND, alignment.overlap, alignment.rmse, reason)

    def _align_settings(self, surface: Surface) -> AlignSettings:
        dot = self.settings.align.min_normal_dot if surface.has_sides else ANY_NORMAL
        return replace(self.settings.align, min_normal_dot=dot)

    def _convinces(self, found: AlignmentResult) -> bool:
        return found.status is not AlignmentStatus.LOST and found.overlap >= self.settings.min_overlap

    def _outcome(self, found: AlignmentResult, count: int) -> FrontEndResult:
        if not self._convinces(found):
            self._velocity = np.eye(4)
            reason = f"{found.overlap:.0%} of {count} points match the map, {self.settings.min_overlap:.0%} needed"
            return FrontEndResult(self._pose.copy(), LocalizationStatus.LOST, found.overlap, found.rmse, reason)
        T = orthonormalize(found.T_world_camera)
        self._velocity, self._pose = inverse(self._pose) @ T, T
        status = LocalizationStatus.DEGENERATE if found.degenerate else LocalizationStatus.OK
        return FrontEndResult(T.copy(), status, found.overlap, found.rmse)
