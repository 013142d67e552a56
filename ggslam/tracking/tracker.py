# SPDX-License-Identifier: Apache-2.0
"""The interface of trackers: they locate each frame against a target that the mapper keeps up to date."""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ggslam.features.orb import FeatureView
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import orthonormalize
from ggslam.system.plurals import quantity
from ggslam.system.savable import savable
from ggslam.tracking.gicp import AlignmentResult, GicpTarget
from ggslam.tracking.motion import CameraMotion
from ggslam.tracking.points import PointSource
from ggslam.tracking.residual_noise import ResidualNoise
from ggslam.tracking.settings import DepthNoise, TrackerSettings
from ggslam.tracking.still_camera import StillCamera


class TrackingStatus(enum.Enum):
    """How a frame was located."""

    FIRST = "first"
    """Nothing to align to yet: the pose is the one the tracker started with."""
    OK = "ok"
    DEGENERATE = "degenerate"
    """Located, but some direction of motion is not seen by the geometry."""
    RECOVERED = "recovered"
    """Constant velocity failed, another start succeeded; `reason` says which."""
    DOUBTED = "doubted"
    """Located as well as can be, but the image does not agree: the camera may be elsewhere; `reason` says more."""
    LOST = "lost"


@dataclass(frozen=True)
class TrackingResult:
    """The pose of a frame.

    Attributes:
        T_world_camera: float64 [4, 4]; when lost, the last known pose.
        status: outcome.
        overlap: share of what the frame shows (points, or planes) with a match near enough.
        rmse_m: root mean square point-to-plane distance of those, metres.
        reason: why it was lost or is doubted, or how it was recovered, else empty.
        points: of the frame; what a keyframe adds to a `MeasuredSurface`.
        information: float64 [6, 6], inverse covariance of the pose, as `AlignmentResult.information` explains it; None
            for the first frame.
        gicp: everything G-ICP says; None for the first frame, and where another method located the frame.
        still: whether the pose is that of the frame before because the image says so (`still_camera`).
    """

    T_world_camera: np.ndarray
    status: TrackingStatus
    overlap: float
    rmse_m: float
    reason: str
    points: PointSource
    information: np.ndarray | None = None
    gicp: AlignmentResult | None = None
    still: bool = False

    @staticmethod
    def by_gicp(
        T_world_camera: np.ndarray, status: TrackingStatus, reason: str, points: PointSource, found: AlignmentResult,
        still: bool = False,
    ) -> TrackingResult:  # fmt: skip
        """The result of a frame that G-ICP aligned; arguments are the attributes of these names."""
        return TrackingResult(
            T_world_camera, status, found.overlap, found.rmse, reason, points, found.information, found, still
        )

    @cached_property
    def median_depth_m(self) -> float:
        """Of the frame's points, metres."""
        return self.points.median_depth


@savable(not_saved="camera context target")
@dataclass
class TrackerState:
    """State that cooperating trackers share.

    Attributes:
        camera: of all frames.
        settings: see `TrackerSettings`.
        context: threads to work on; the tracker's own, so that it does not wait for other users.
        motion: of the camera, as far as it is known.
        target: what frames are aligned to; None until the first keyframe is in.
        noise: of the depth camera; measured on the first frame if the settings leave it open, and held to the
            residuals of the frames that follow.
        residuals: what these say.
        still: since when the camera stands still.
    """

    camera: Camera
    settings: TrackerSettings
    context: NativeContext
    motion: CameraMotion
    target: GicpTarget | None = None
    noise: DepthNoise | None = None
    residuals: ResidualNoise = field(default_factory=ResidualNoise)
    still: StillCamera = field(default_factory=StillCamera)

    @staticmethod
    def begin(
        camera: Camera, settings: TrackerSettings | None, context: NativeContext | None,
        T_world_camera: np.ndarray | None,
    ) -> TrackerState:  # fmt: skip
        """The state before the first frame, which has the pose `T_world_camera` [4, 4]."""
        settings = settings or TrackerSettings()
        motion = CameraMotion(np.eye(4) if T_world_camera is None else np.array(T_world_camera, float))
        return TrackerState(camera, settings, context or NativeContext(), motion, noise=settings.noise)


class Tracker(ABC):
    """Locates frames. The target is swapped in whenever it is ready (`set_target`, from any thread); the tracker never
    waits for it.

    Args:
        state: what it knows; another tracker may work with the same.
    """

    def __init__(self, state: TrackerState) -> None:
        self.state = state

    @abstractmethod
    def track(self, frame: Frame) -> TrackingResult:
        """Locates a frame. Takes the target as it is; without one the frame gets the current pose.

        Raises:
            ValueError: the depth image does not fit the camera.
        """

    @property
    def camera(self) -> Camera:
        """Of all frames."""
        return self.state.camera

    @property
    def settings(self) -> TrackerSettings:
        """May be changed between two frames."""
        return self.state.settings

    @settings.setter
    def settings(self, settings: TrackerSettings) -> None:
        self.state.settings = settings

    @property
    def context(self) -> NativeContext:
        """Threads to work on."""
        return self.state.context

    @context.setter
    def context(self, context: NativeContext) -> None:
        self.state.context = context

    @property
    def noise(self) -> DepthNoise | None:
        """Of the depth camera; None until the first frame unless the settings say it."""
        return self.state.noise

    @noise.setter
    def noise(self, noise: DepthNoise | None) -> None:
        self.state.noise = noise

    @property
    def target(self) -> GicpTarget | None:
        """What frames are aligned to; None until the first keyframe is in."""
        return self.state.target

    @target.setter
    def target(self, target: GicpTarget | None) -> None:
        self.state.target = target

    def set_target(self, target: GicpTarget) -> None:
        """Frames are aligned to `target` from the next one on."""
        self.state.target = target

    def expect_target(self, target: GicpTarget) -> None:
        """Frames will be aligned to `target` soon: it is brought nearer to where that is done, in the caller's thread.
        """
        return  # most have nothing to do

    def expect_motion(self) -> None:
        """Something may move: near points are trusted less for a while, whoever they belong to."""
        self.state.motion.wary = self.settings.recovery.wary_frames

    def start_lost(self, target: GicpTarget) -> None:
        """Nothing is known of the camera's pose but that it is somewhere at `target`; see `relocate`."""
        self.state.target, self.state.motion.lost = target, True

    def move(self, T_new_old: np.ndarray) -> None:
        """Moves the tracker's own pose, after the world about it was moved by a correction [4, 4]."""
        self.state.motion.move(T_new_old)
        self.state.still.move(T_new_old)

    def relocate(self, view: FeatureView, points: PointSource, found: AlignmentResult, source: str) -> TrackingResult:
        """A frame that was lost was located by other means; tracking goes on from there.

        Args:
            view: the frame.
            points: of the frame.
            found: where it is.
            source: how that is known, for `TrackingResult.reason`.
        """
        motion, T = self.state.motion, orthonormalize(found.T_world_camera)
        motion.restart(view, T)
        self.state.still.forget()
        motion.remember(view, points, self.settings)
        return TrackingResult.by_gicp(T.copy(), TrackingStatus.RECOVERED, source, points, found)

    def track_from(self, frame: Frame, motion: CameraMotion, target: GicpTarget) -> TrackingResult:
        """Tries to locate a frame that was lost, as a camera that was lost elsewhere; if that succeeds without doubt,
        tracking goes on there, else nothing changes and the frame is lost.

        Args:
            frame: the frame.
            motion: of that camera; it is changed.
            target: what was to be seen there.
        """
        state = self.state
        before = state.motion, state.target
        state.motion, state.target = motion, target
        result = self.track(frame)
        if result.status is TrackingStatus.DOUBTED:
            result = replace(result, status=TrackingStatus.LOST)
        if result.status is TrackingStatus.LOST:
            state.motion, state.target = before
            state.still.forget()
        return result

    def begin_part(self, view: FeatureView, points: PointSource, T_world_camera: np.ndarray) -> TrackingResult:
        """Nothing knows where a lost frame is: tracking goes on from it at a pose [4, 4] of the caller's choice.

        Args:
            view: the frame, which becomes a keyframe.
            points: of the frame.
            T_world_camera: where nothing else was mapped.
        """
        motion, T = self.state.motion, np.array(T_world_camera, float)
        self.state.still.forget()
        motion.restart(view, T)
        motion.remember(view, points, self.settings)
        return TrackingResult(T.copy(), TrackingStatus.FIRST, 1.0, 0.0, "a new part of the map begins", points)

    def _begin(self, view: FeatureView, points: PointSource) -> TrackingResult:
        """Before the first keyframe: the pose is given, and all a frame needs is depth to begin with."""
        motion, needed = self.state.motion, self.settings.align.min_matches
        if len(points) < needed:
            reason = f"only {quantity(len(points), 'point has', 'points have')} depth, {needed} needed"
            return TrackingResult(motion.T_world_camera.copy(), TrackingStatus.LOST, 0.0, 0.0, reason, points)
        motion.remember(view, points, self.settings)
        return TrackingResult(motion.T_world_camera.copy(), TrackingStatus.FIRST, 1.0, 0.0, "", points)
