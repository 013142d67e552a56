# SPDX-License-Identifier: Apache-2.0
"""Locates frame after frame against a target that someone else keeps up to date."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, orthonormalized
from ggslam.tracking.gicp import AlignmentResult, AlignmentStatus, GicpTarget, align
from ggslam.tracking.points import FramePoints, extract_points
from ggslam.tracking.recovery import View, feature_starts
from ggslam.tracking.settings import TrackerSettings

__all__ = ["Tracker", "TrackerSettings", "TrackingResult", "TrackingStatus"]


class TrackingStatus(enum.Enum):
    """How a frame was located."""

    FIRST = "first"
    """Nothing to align to yet: the pose is the one the tracker started with."""
    OK = "ok"
    DEGENERATE = "degenerate"
    """Located, but some direction of motion is not seen by the geometry."""
    RECOVERED = "recovered"
    """Constant velocity failed, another start succeeded; `reason` says which."""
    LOST = "lost"


@dataclass(frozen=True)
class TrackingResult:
    """Where a frame is.

    Attributes:
        T_world_camera: float64 [4, 4]; when lost, the last known pose.
        status: outcome.
        overlap: share of the frame's points with a match near enough (`AlignmentResult.overlap`).
        rmse_m: root mean square point-to-plane distance of those, metres.
        reason: why it was lost or how it was recovered, else empty.
        points: of the frame; what a keyframe adds to a `MeasuredSurface`.
        alignment: everything G-ICP says; None for the first frame.
    """

    T_world_camera: np.ndarray
    status: TrackingStatus
    overlap: float
    rmse_m: float
    reason: str
    points: FramePoints
    alignment: AlignmentResult | None = None

    @property
    def median_depth_m(self) -> float:
        """Of the frame's points, metres."""
        return self.points.median_depth


class Tracker:
    """Constant velocity, then G-ICP; if that fails, other starts.

    The target is swapped in whenever it is ready (`set_target`, from any thread); the tracker never waits for it.

    Args:
        camera: of all frames.
        settings: see `TrackerSettings`.
        context: threads to work on; the tracker's own, so that it does not wait for other users.
        T_world_camera: pose of the first frame.
    """

    def __init__(
        self,
        camera: Camera,
        settings: TrackerSettings | None = None,
        context: NativeContext | None = None,
        T_world_camera: np.ndarray | None = None,
    ) -> None:
        self.camera = camera
        self.settings = settings or TrackerSettings()
        self.context = context or NativeContext()
        self.target: GicpTarget | None = None
        """What frames are aligned to; None until the first keyframe is in."""
        self._pose = np.eye(4) if T_world_camera is None else np.array(T_world_camera, float)
        self._velocity = np.eye(4)
        self._views: list[View] = []

    def set_target(self, target: GicpTarget) -> None:
        """Frames are aligned to `target` from the next one on."""
        self.target = target

    def track(self, frame: Frame) -> TrackingResult:
        """Locates a frame. Takes the target as it is; without one the frame gets the current pose.

        Raises:
            ValueError: the depth image does not fit the camera.
        """
        s, target = self.settings, self.target
        points = extract_points(frame.depth, self.camera, s.points, s.noise, self.context)
        if target is None:
            self._remember(frame, self._pose)
            return TrackingResult(self._pose.copy(), TrackingStatus.FIRST, 1.0, 0.0, "", points)
        found = self._align(points, target, self._pose @ self._velocity)
        status = TrackingStatus.DEGENERATE if found.degenerate else TrackingStatus.OK
        reason = ""
        if not self._convincing(found):
            found, reason = self._retry(frame, points, target, found)
            status = TrackingStatus.RECOVERED if reason else status
        if not self._acceptable(found):
            return self._lost(points, found)
        T = orthonormalized(found.T_world_camera)
        self._velocity = inverse(self._pose) @ T
        self._pose = T
        self._remember(frame, T)
        return TrackingResult(T.copy(), status, found.overlap, found.rmse, reason, points, found)

    def move(self, T_new_old: np.ndarray) -> None:
        """Moves the tracker's own pose, after the world about it was moved by a correction [4, 4]."""
        self._pose = orthonormalized(T_new_old @ self._pose)
        self._views = [View(v.color, v.depth, T_new_old @ v.T_world_camera) for v in self._views]

    # --- parts -------------------------------------------------------------------------------------------------------

    def _align(self, points: FramePoints, target: GicpTarget, guess: np.ndarray) -> AlignmentResult:
        return align(points, target, guess, self.settings.align, self.settings.noise, self.context)

    def _convincing(self, found: AlignmentResult) -> bool:
        return found.status is not AlignmentStatus.LOST and found.overlap >= self.settings.recovery.convincing_overlap

    def _acceptable(self, found: AlignmentResult) -> bool:
        return found.status is not AlignmentStatus.LOST and found.overlap >= self.settings.recovery.min_overlap

    def _retry(
        self, frame: Frame, points: FramePoints, target: GicpTarget, found: AlignmentResult
    ) -> tuple[AlignmentResult, str]:
        """The best alignment over all starts, and which start it came from (empty: constant velocity)."""
        best, reason = found, ""
        starts = [("last pose", self._pose)]
        starts += feature_starts(frame, self.camera, self._views, self.settings.recovery)
        for name, guess in starts:
            candidate = self._align(points, target, guess)
            if candidate.status is not AlignmentStatus.LOST and self._score(candidate) > self._score(best):
                best, reason = candidate, name
        return best, reason

    def _score(self, found: AlignmentResult) -> float:
        """More overlap is better; a loose fit costs a little."""
        if found.status is AlignmentStatus.LOST:
            return -1.0
        return found.overlap - 2.0 * found.rmse

    def _lost(self, points: FramePoints, found: AlignmentResult) -> TrackingResult:
        """Stays where it was last known, standing still."""
        self._velocity = np.eye(4)
        limit = self.settings.recovery.min_overlap
        reason = f"{found.overlap:.0%} of {len(points)} points match the map, {limit:.0%} needed, from every start"
        if len(points) < self.settings.align.min_matches:
            reason = f"only {len(points)} points have depth, {self.settings.align.min_matches} needed"
        return TrackingResult(self._pose.copy(), TrackingStatus.LOST, found.overlap, found.rmse, reason, points, found)

    def _remember(self, frame: Frame, T_world_camera: np.ndarray) -> None:
        """Keeps the last located frames for feature matching."""
        self._views = [View(frame.color, frame.depth, T_world_camera), *self._views[: self.settings.recovery.views - 1]]
