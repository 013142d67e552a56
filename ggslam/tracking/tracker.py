# SPDX-License-Identifier: Apache-2.0
"""Locates frame after frame against a target that someone else keeps up to date."""

from __future__ import annotations

import dataclasses
import enum
from dataclasses import dataclass

import numpy as np

from ggslam.features.orb import FeatureView, pose_from_matches
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, orthonormalized, separation
from ggslam.tracking.engine import NativeEngine, TrackingEngine
from ggslam.tracking.gicp import AlignmentResult, AlignmentStatus, GicpTarget, PhotometricPart
from ggslam.tracking.noise import estimate_noise
from ggslam.tracking.photometric import GreyDepth, PhotometricReference, textured_points
from ggslam.tracking.points import FramePoints
from ggslam.tracking.settings import DepthNoise, PhotometricMode, TrackerSettings

__all__ = ["Tracker", "TrackerSettings", "TrackingResult", "TrackingStatus"]

MIN_TEXTURED = 200
"""Textured points from which grey values are trusted."""


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
    """Constant velocity, then G-ICP, with grey values where geometry leaves a direction open; if that fails, other
    starts.

    Grey values are compared with an earlier frame, which the tracker chooses by itself, unless `set_reference` was
    given another image.

    The target is swapped in whenever it is ready (`set_target`, from any thread); the tracker never waits for it.

    Args:
        camera: of all frames.
        settings: see `TrackerSettings`.
        context: threads to work on; the tracker's own, so that it does not wait for other users.
        T_world_camera: pose of the first frame.
        engine: where points are extracted and aligned; None: on the threads of `context`.
    """

    def __init__(
        self,
        camera: Camera,
        settings: TrackerSettings | None = None,
        context: NativeContext | None = None,
        T_world_camera: np.ndarray | None = None,
        engine: TrackingEngine | None = None,
    ) -> None:
        self.camera = camera
        self.settings = settings or TrackerSettings()
        self.context = context or NativeContext()
        self.target: GicpTarget | None = None
        """What frames are aligned to; None until the first keyframe is in."""
        self.noise: DepthNoise | None = self.settings.noise
        """Of the depth camera; measured on the first frame if the settings leave it open."""
        self._given_engine = engine
        self._median_depth: float | None = None
        self._pose = np.eye(4) if T_world_camera is None else np.array(T_world_camera, float)
        self._velocity = np.eye(4)
        self._was_lost = False
        self._views: list[FeatureView] = []
        self._reference_view: FeatureView | None = None
        self._reference: PhotometricReference | None = None

    @property
    def engine(self) -> TrackingEngine:
        """Where points are extracted and aligned."""
        return self._given_engine or NativeEngine(self.camera, self.context)

    def set_target(self, target: GicpTarget) -> None:
        """Frames are aligned to `target` from the next one on."""
        self.target = target

    def start_lost(self, target: GicpTarget) -> None:
        """Nothing is known of the camera's pose but that it is somewhere at `target`; see `relocate`."""
        self.target, self._was_lost = target, True

    def set_reference(self, reference: PhotometricReference | None) -> None:
        """Grey values are compared with `reference` until the tracker has moved on and takes a frame of its own."""
        self._reference = reference

    def track(self, frame: Frame) -> TrackingResult:
        """Locates a frame. Takes the target as it is; without one the frame gets the current pose.

        Raises:
            ValueError: the depth image does not fit the camera.
        """
        target = self.target
        if self.noise is None:
            self.noise = estimate_noise(frame.depth, self.camera)
        noise = self.noise or DepthNoise()
        points = self.engine.points(frame.depth, self.settings.points, noise)
        view = FeatureView(frame.color, frame.depth, self._pose)
        if target is None:
            return self._first(view, points)
        self.noise = noise  # what could not be measured before the first keyframe is taken as usual
        found, reason = self._locate(view, points, target)
        if not self._acceptable(found):
            return self._lost(points, found)
        T = orthonormalized(found.T_world_camera)
        self._velocity = np.eye(4) if self._was_lost else inverse(self._pose) @ T
        self._was_lost = False
        self._pose = view.T_world_camera = T
        self._remember(view, points)
        status = TrackingStatus.DEGENERATE if found.degenerate else TrackingStatus.OK
        status = TrackingStatus.RECOVERED if reason else status
        return TrackingResult(T.copy(), status, found.overlap, found.rmse, reason, points, found)

    def _first(self, view: FeatureView, points: FramePoints) -> TrackingResult:
        """Before the first keyframe: the pose is given, and all a frame needs is depth to begin with."""
        if len(points) < self.settings.align.min_matches:
            reason = f"only {len(points)} points have depth, {self.settings.align.min_matches} needed"
            return TrackingResult(self._pose.copy(), TrackingStatus.LOST, 0.0, 0.0, reason, points)
        self._remember(view, points)
        return TrackingResult(self._pose.copy(), TrackingStatus.FIRST, 1.0, 0.0, "", points)

    def move(self, T_new_old: np.ndarray) -> None:
        """Moves the tracker's own pose, after the world about it was moved by a correction [4, 4]."""
        self._pose = orthonormalized(T_new_old @ self._pose)
        for view in {id(v): v for v in (*self._views, self._reference_view) if v is not None}.values():
            view.T_world_camera = T_new_old @ view.T_world_camera
        self._reference = None

    def relocate(self, view: FeatureView, points: FramePoints, found: AlignmentResult, source: str) -> TrackingResult:
        """A frame that was lost was located by other means; tracking goes on from there.

        Args:
            view: the frame.
            points: of the frame.
            found: where it is.
            source: how that is known, for `TrackingResult.reason`.
        """
        T = orthonormalized(found.T_world_camera)
        self._velocity, self._was_lost = np.eye(4), False
        self._pose = view.T_world_camera = T
        self._views, self._reference_view, self._reference = [], None, None
        self._remember(view, points)
        return TrackingResult(T.copy(), TrackingStatus.RECOVERED, found.overlap, found.rmse, source, points, found)

    # --- parts -------------------------------------------------------------------------------------------------------

    def _locate(self, view: FeatureView, points: FramePoints, target: GicpTarget) -> tuple[AlignmentResult, str]:
        """The best alignment, and which start it came from (empty: constant velocity)."""
        depth = points.median_depth_if_known()
        expected = self._median_depth if depth is None else depth
        mode = self._mode(points.median_depth if expected is None else expected)
        found = self._locate_by(mode, view, points, target)
        if depth is None:  # it is known now, and seldom so far from the frame's before that the mode is another one
            self._median_depth = points.median_depth
            actual = self._mode(self._median_depth)
            return found if actual == mode else self._locate_by(actual, view, points, target)
        return found

    def _locate_by(
        self, mode: PhotometricMode, view: FeatureView, points: FramePoints, target: GicpTarget
    ) -> tuple[AlignmentResult, str]:
        """As `_locate`, in a photometric mode."""
        guess = self._pose @ self._velocity
        photometric = self._photometric_part(view) if mode == "always" or self._was_lost else None
        found = self._align(points, target, guess, photometric)
        if photometric is not None and not self._explains_greys(found) and not found.degenerate:
            # Images that do not agree (too far apart, shutters out of step) must not pull at good geometry.
            found = self._align(points, target, guess, None)
        if self._convincing(found) and not (found.degenerate and mode != "never"):
            return found, ""
        if photometric is None and found.degenerate and mode != "never":
            photometric = self._photometric_part(view)
            found = self._align(points, target, guess, photometric) if photometric else found
        if self._convincing(found) and self._explains_greys(found):
            return found, ""
        return self._retry(view, points, target, found, photometric)

    def _mode(self, median_depth: float) -> PhotometricMode:
        """The photometric mode with "auto" decided."""
        settings = self.settings.photometric
        if settings.mode != "auto":
            return settings.mode
        assert self.noise is not None
        return "always" if self.noise.sigma(median_depth) > settings.noisy_m else "degenerate"

    def _align(
        self, points: FramePoints, target: GicpTarget, guess: np.ndarray, photometric: PhotometricPart | None,
        coarse: bool = True,
    ) -> AlignmentResult:  # fmt: skip
        assert self.noise is not None
        settings = self.settings.align if coarse else dataclasses.replace(self.settings.align, coarse_iterations=0)
        return self.engine.align(points, target, guess, settings, self.noise, photometric)

    def _photometric_part(self, view: FeatureView) -> PhotometricPart | None:
        """Textured points of the view and the reference; None without either."""
        settings = self.settings.photometric
        reference = self._current_reference()
        if reference is None:
            return None
        points = textured_points(self._small(view), settings)
        return PhotometricPart(points, reference, settings) if len(points) >= MIN_TEXTURED else None

    def _current_reference(self) -> PhotometricReference | None:
        if self._reference is None and self._reference_view is not None:
            view = self._reference_view
            self._reference = PhotometricReference.from_view(self._small(view), view.T_world_camera)
        return self._reference

    def _small(self, view: FeatureView) -> GreyDepth:
        shrink = self.settings.photometric.shrink * max(1, round(self.camera.width / 320))
        return GreyDepth.from_images(view.color, view.depth, self.camera, shrink)

    def _convincing(self, found: AlignmentResult) -> bool:
        return found.status is not AlignmentStatus.LOST and found.overlap >= self.settings.recovery.convincing_overlap

    def _explains_greys(self, found: AlignmentResult) -> bool:
        """Whether the images agree at the pose found; true if none were compared."""
        limit = self.settings.recovery.convincing_residual
        return found.photometric_share == 0 or found.photometric_residual <= limit

    def _acceptable(self, found: AlignmentResult) -> bool:
        """Whether to believe a pose at all. Some overlap can be had anywhere (a floor is a floor), so that a pose short
        of the convincing overlap, or after being lost, must be witnessed by grey values."""
        if found.status is AlignmentStatus.LOST or found.overlap < self.settings.recovery.min_overlap:
            return False
        if self._was_lost:
            return self._witnessed(found)
        return self._convincing(found) or self._witnessed(found, tolerance=2)

    def _witnessed(self, found: AlignmentResult, tolerance: float = 1) -> bool:
        """Whether there is some overlap and the images agree over enough of the frame."""
        recovery = self.settings.recovery
        if found.status is AlignmentStatus.LOST or found.overlap < recovery.min_overlap:
            return False
        seen = found.photometric_share >= recovery.min_share
        return seen and found.photometric_residual <= tolerance * recovery.convincing_residual

    def _retry(
        self, view: FeatureView, points: FramePoints, target: GicpTarget, found: AlignmentResult,
        photometric: PhotometricPart | None,
    ) -> tuple[AlignmentResult, str]:  # fmt: skip
        """The best alignment over all starts."""
        photometric = photometric or self._photometric_part(view)
        best, reason = found, ""
        if photometric is not None and found.photometric_share == 0:  # all starts are compared by the same measure
            best = self._align(points, target, self._pose @ self._velocity, photometric)
        # Feature matches are good to a centimetre or two; the coarse level would slide off along a bare wall.
        starts = [("last pose", self._pose, True)]
        for number, earlier in enumerate(self._views):
            pose = pose_from_matches(view, earlier, self.camera, self.settings.recovery.features)
            if pose is not None:
                starts.append((f"features of view {number}", pose.T_world_camera, False))
        for name, guess, coarse in starts:
            candidate = self._align(points, target, guess, photometric, coarse)
            if self._better(candidate, best):
                best, reason = candidate, name
        return best, reason

    @staticmethod
    def _better(candidate: AlignmentResult, best: AlignmentResult) -> bool:
        """Whether an alignment of the same points beats another.

        With grey values the joint cost decides: sliding along a bare wall keeps all the overlap. Without them more
        overlap is better, and a loose fit costs a little.
        """
        if candidate.status is AlignmentStatus.LOST or best.status is AlignmentStatus.LOST:
            return candidate.status is not AlignmentStatus.LOST
        if candidate.photometric_share > 0 and best.photometric_share > 0:
            return candidate.cost < best.cost
        return candidate.overlap - 2.0 * candidate.rmse > best.overlap - 2.0 * best.rmse

    def _lost(self, points: FramePoints, found: AlignmentResult) -> TrackingResult:
        """Stays where it was last known, standing still."""
        self._velocity = np.eye(4)
        self._was_lost = True
        limit = self.settings.recovery.min_overlap
        reason = f"{found.overlap:.0%} of {len(points)} points match the map, {limit:.0%} needed, from every start"
        if found.overlap >= limit:
            reason = (
                f"only {found.overlap:.0%} of {len(points)} points match the map, and the image does not agree "
                f"(mean grey difference {found.photometric_residual:.3f} over {found.photometric_share:.0%} of it)"
            )
        if len(points) < self.settings.align.min_matches:
            reason = f"only {len(points)} points have depth, {self.settings.align.min_matches} needed"
        return TrackingResult(self._pose.copy(), TrackingStatus.LOST, found.overlap, found.rmse, reason, points, found)

    def _remember(self, view: FeatureView, points: FramePoints) -> None:
        """Keeps the last located frames for feature matching, and a not too distant one for its grey values."""
        self._views = [view, *self._views[: self.settings.recovery.views - 1]]
        reference = self._reference_view
        if reference is None or self._is_far(reference.T_world_camera, view.T_world_camera, points.median_depth):
            self._reference_view, self._reference = view, None

    def _is_far(self, T_world_reference: np.ndarray, T_world_camera: np.ndarray, depth: float) -> bool:
        settings = self.settings.photometric
        moved, turned = separation(T_world_reference, T_world_camera)
        return moved > settings.renew_translation * depth or turned > settings.renew_rotation_deg
