# SPDX-License-Identifier: Apache-2.0
"""The tracker that aligns frames by G-ICP, with the way back after it was lost."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from ggslam.features.orb import FeatureView
from ggslam.geometry.moved_depth import largest_shift
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, orthonormalize
from ggslam.tracking.engine import CpuTrackingEngine, TrackingEngine
from ggslam.tracking.feature_hold import hold_to_features
from ggslam.tracking.gicp import AlignmentResult, AlignmentStatus, GicpTarget, PhotometricPart
from ggslam.tracking.noise import estimate_noise
from ggslam.tracking.photometric import GreyDepth, PhotometricReference, textured_points
from ggslam.tracking.points import PointSource
from ggslam.tracking.seen_before import share_seen_before
from ggslam.tracking.settings import DepthNoise, PhotometricMode, TrackerSettings
from ggslam.tracking.shared_features import JUMP_SLACK, SharedFeatures
from ggslam.tracking.still_camera import SmallFrame
from ggslam.tracking.tracker import Tracker, TrackerState, TrackingResult, TrackingStatus

MIN_TEXTURED = 200
"""Textured points from which grey values are trusted."""
ALIKE_SHARE = 0.01
"""Of the image width, by which the image shifts between two starts of which one is enough."""
LEAST_SEEN = 0.5
"""Share of a frame that the last views have to show where its overlap is held to that."""
USUAL_DEPTH = 2.0
"""Metres, of scenes whose median depth is not known yet."""


class GicpTracker(Tracker):
    """Constant velocity, then G-ICP, with grey values where geometry leaves a direction open; if that fails, other
    starts. Grey values are compared with an earlier frame, which the tracker chooses by itself.

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
        super().__init__(TrackerState.begin(camera, settings, context, T_world_camera))
        self._given_engine = engine
        self._median_depth: float | None = None
        self._features: SharedFeatures | None = None
        """Of the frame at hand, once they were asked for."""

    @classmethod
    def with_state(cls, state: TrackerState) -> GicpTracker:
        """A tracker that works with the state of another."""
        tracker = cls(state.camera, state.settings, state.context)
        tracker.state = state
        return tracker

    @property
    def engine(self) -> TrackingEngine:
        """Where points are extracted and aligned."""
        return self._given_engine or CpuTrackingEngine(self.camera, self.context)

    @engine.setter
    def engine(self, engine: TrackingEngine) -> None:
        self._given_engine = engine

    def track(self, frame: Frame) -> TrackingResult:
        """See `Tracker.track`."""
        target, motion = self.target, self.state.motion
        if self.noise is None:
            self.noise = estimate_noise(frame.depth, self.camera)
        noise = self.noise or DepthNoise()
        points = self._points(frame.depth, noise)
        motion.wary = max(0, motion.wary - 1)
        view = FeatureView(frame.color, frame.depth, motion.T_world_camera)
        motion.watch(frame.color, self.camera)
        small, still = SmallFrame.of(frame.color, frame.depth), self.state.still
        if target is None:
            still.renew(small, motion.T_world_camera)
            return self._begin(view, points)
        self.noise = noise  # what could not be measured before the first keyframe is taken as usual
        self._features = None
        if not motion.lost and still.holds(small, noise):
            stayed = self._stay(view, points, target)
            if stayed is not None:
                return stayed
        found, reason = self._locate(view, points, target)
        if not motion.wary and found.photometric_share > 0 and motion.is_sudden(found.photometric_residual):
            motion.wary = self.settings.recovery.wary_frames
            points = self._points(frame.depth, noise)
            found, reason = self._locate(view, points, target)
        if not self._is_acceptable(found, points):
            return self._give_up(points, found)
        T = orthonormalize(found.T_world_camera)
        self._look_at_residuals(points, found)
        doubt = self._features.contradict(T, JUMP_SLACK) if self._features is not None else ""
        self._features = None
        still.renew(small, T)
        motion.follow(view, T)
        if found.photometric_share > 0:
            motion.note_greys(found.photometric_residual)
        motion.remember(view, points, self.settings)
        status = TrackingStatus.DEGENERATE if found.degenerate else TrackingStatus.OK
        status = TrackingStatus.RECOVERED if reason else status
        if doubt:
            status, reason = TrackingStatus.DOUBTED, f"only {doubt}"
        return TrackingResult(T.copy(), status, found.overlap, found.rmse, reason, points, found)

    # --- parts -------------------------------------------------------------------------------------------------------

    def _stay(self, view: FeatureView, points: PointSource, target: GicpTarget) -> TrackingResult | None:
        """A camera that stands still is where it was, whatever moves before it; None: too little matches the map."""
        still, motion = self.state.still, self.state.motion
        assert still.T_world_camera is not None
        found = self._align(points, target, still.T_world_camera, None, coarse=False)
        if found.status is AlignmentStatus.LOST:
            return None
        T = still.T_world_camera
        still.frames += 1
        motion.follow(view, T.copy())
        motion.remember(view, points, self.settings)
        held = dataclasses.replace(found, T_world_camera=T.copy())
        return TrackingResult(T.copy(), TrackingStatus.OK, found.overlap, found.rmse, "", points, held, still=True)

    def _points(self, depth: np.ndarray, noise: DepthNoise) -> PointSource:
        settings = self.settings.points
        if self.state.motion.wary:
            near = min(settings.near_weight, self.settings.recovery.near_weight)
            settings = dataclasses.replace(settings, near_weight=near)
        return self.engine.points(depth, settings, noise)

    def _look_at_residuals(self, points: PointSource, found: AlignmentResult) -> None:
        """Noise that was measured on the first frame is taken to be larger where frames do not lie on one another."""
        if self.settings.noise is None and self.noise is not None and self.state.residuals.due():
            self.noise = self.state.residuals.observe(points.read(), found.matches.read().squared_distances, self.noise)

    def _locate(self, view: FeatureView, points: PointSource, target: GicpTarget) -> tuple[AlignmentResult, str]:
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
        self, mode: PhotometricMode, view: FeatureView, points: PointSource, target: GicpTarget
    ) -> tuple[AlignmentResult, str]:
        """As `_locate`, in a photometric mode."""
        guess, coarse = self._start(view)
        photometric = self._photometric_part(view) if mode == "always" or self.state.motion.lost else None
        found = self._align(points, target, guess, photometric, coarse)
        if not coarse:
            found = self._hold(found, guess, view, points)
        if photometric is not None and not self._explains_greys(found) and not found.degenerate:
            # Images that do not agree (too far apart, shutters out of step) must not pull at good geometry.
            found = self._align(points, target, guess, None, coarse)
            if self._share(view).contradict(found.T_world_camera):
                return self._retry(view, points, target, found, photometric)
        if photometric is None and found.degenerate and mode != "never":
            photometric = self._photometric_part(view)
            found = self._align(points, target, guess, photometric, coarse) if photometric else found
        sure = mode == "never" or not found.degenerate or self._explains_greys(found)
        if sure and self._is_convincing(found) and not self._is_far_off(view, found):
            return found, ""
        if not coarse and self._is_vouched(found):
            return found, ""
        return self._retry(view, points, target, found, photometric)

    def _start(self, view: FeatureView) -> tuple[np.ndarray, bool]:
        """Where the first alignment starts [4, 4], and whether coarsely: at constant velocity, or where that moves the
        image far, at what the features vouch for."""
        guess = self.state.motion.predict()
        if self._is_wide(guess):
            shared = self._share(view)
            for _, pose in shared.starts():
                if shared.vouch(pose):
                    return pose, False
        return guess, True

    def _hold(
        self, found: AlignmentResult, start: np.ndarray, view: FeatureView, points: PointSource
    ) -> AlignmentResult:
        """See `hold_to_features`."""
        enough = self.settings.recovery.convincing_overlap
        return hold_to_features(found, start, self._share(view), points, self._noise(), enough)

    def _is_wide(self, T_world_camera: np.ndarray) -> bool:
        """Whether the image shifts far from the last pose to this one [4, 4]."""
        T_new_old = inverse(T_world_camera) @ self.state.motion.T_world_camera
        shift = largest_shift(T_new_old, self.camera, self._median_depth or USUAL_DEPTH)
        return shift > self.settings.recovery.wide_share * self.camera.width

    def _is_far_off(self, view: FeatureView, found: AlignmentResult) -> bool:
        """Whether a pose after a wide step, where alignments have several minima, is not where features have it."""
        if not self._is_wide(found.T_world_camera):
            return False
        shared = self._share(view)
        if found.degenerate and shared.could_vouch:
            return not shared.vouch(found.T_world_camera)
        return bool(shared.contradict(found.T_world_camera))

    def _mode(self, median_depth: float) -> PhotometricMode:
        """The photometric mode with "auto" decided."""
        settings = self.settings.photometric
        if settings.mode != "auto":
            return settings.mode
        noise = self._noise().sigma(median_depth)
        if self.settings.noise is None:  # smooth depth may be wrong: it is trusted once residuals have shown its error
            shown = self.state.residuals.sigma
            noise = math.inf if shown is None else max(shown, noise)
        return "always" if noise > settings.noisy_m else "degenerate"

    def _align(
        self, points: PointSource, target: GicpTarget, guess: np.ndarray, photometric: PhotometricPart | None,
        coarse: bool = True,
    ) -> AlignmentResult:  # fmt: skip
        settings = self.settings.align if coarse else dataclasses.replace(self.settings.align, coarse_iterations=0)
        return self.engine.align(points, target, guess, settings, self._noise(), photometric)

    def _noise(self) -> DepthNoise:
        assert self.noise is not None
        return self.noise

    def _photometric_part(self, view: FeatureView) -> PhotometricPart | None:
        """Textured points of the view and the reference; None without either."""
        settings = self.settings.photometric
        reference = self._current_reference()
        if reference is None:
            return None
        points = textured_points(self._shrink(view), settings)
        return PhotometricPart(points, reference, settings) if len(points) >= MIN_TEXTURED else None

    def _current_reference(self) -> PhotometricReference | None:
        motion = self.state.motion
        if motion.reference is None and motion.reference_view is not None:
            view = motion.reference_view
            motion.reference = PhotometricReference.from_view(self._shrink(view), view.T_world_camera)
        return motion.reference

    def _shrink(self, view: FeatureView) -> GreyDepth:
        shrink = self.settings.photometric.shrink * max(1, round(self.camera.width / 320))
        return GreyDepth.from_images(view.color, view.depth, self.camera, shrink)

    def _is_convincing(self, found: AlignmentResult) -> bool:
        return found.status is not AlignmentStatus.LOST and found.overlap >= self.settings.recovery.convincing_overlap

    def _is_vouched(self, found: AlignmentResult) -> bool:
        """Whether features, if they were asked, vouch for a pose."""
        if found.status is AlignmentStatus.LOST or self._features is None:
            return False
        return self._features.vouch(found.T_world_camera)

    def _explains_greys(self, found: AlignmentResult) -> bool:
        """Whether the images agree at the pose found; true if none were compared."""
        limit = self.settings.recovery.convincing_residual
        return found.photometric_share == 0 or found.photometric_residual <= limit

    def _is_acceptable(self, found: AlignmentResult, points: PointSource) -> bool:
        """Whether to believe a pose at all. Some overlap can be had anywhere (a floor is a floor), so that a pose short
        of the convincing overlap, or after being lost, must be witnessed by grey values."""
        if found.status is AlignmentStatus.LOST:
            return False
        if self._is_vouched(found):
            return True
        if found.overlap < self.settings.recovery.min_overlap:
            return False
        if self.state.motion.lost:
            return self._is_witnessed(found)
        if self._is_convincing(found) or self._is_witnessed(found, tolerance=2):
            return True
        return not found.degenerate and self._matches_what_was_seen(found, points)

    def _matches_what_was_seen(self, found: AlignmentResult, points: PointSource) -> bool:
        """Whether the overlap is convincing for so much as the last views show of the frame: a fast turn leaves
        little, and its blurred image bears no witness."""
        views, needed = self.state.motion.views, self.settings.recovery.convincing_overlap
        seen = share_seen_before(points.read(), found.T_world_camera, views, self.camera)
        if seen < LEAST_SEEN or found.overlap < needed * seen:
            return False
        return self._features is None or not self._features.contradict(found.T_world_camera, JUMP_SLACK)

    def _is_witnessed(self, found: AlignmentResult, tolerance: float = 1) -> bool:
        """Whether there is some overlap and the images agree over enough of the frame."""
        recovery = self.settings.recovery
        if found.status is AlignmentStatus.LOST or found.overlap < recovery.min_overlap:
            return False
        seen = found.photometric_share >= recovery.min_share
        return seen and found.photometric_residual <= tolerance * recovery.convincing_residual

    def _share(self, view: FeatureView) -> SharedFeatures:
        """Features that the view shares with the last located ones; matched once."""
        if self._features is None:
            earlier, settings = self.state.motion.views, self.settings.recovery.features
            self._features = SharedFeatures(view, earlier, self.camera, settings)
        return self._features

    def _retry(
        self, view: FeatureView, points: PointSource, target: GicpTarget, found: AlignmentResult,
        photometric: PhotometricPart | None,
    ) -> tuple[AlignmentResult, str]:  # fmt: skip
        """The best alignment over all starts."""
        photometric = photometric or self._photometric_part(view)
        best, reason = found, ""
        if photometric is not None and found.photometric_share == 0:  # all starts are compared by the same measure
            best = self._align(points, target, self.state.motion.predict(), photometric)
        shared = self._share(view)
        for name, guess, coarse in self._starts(shared):
            candidate = self._align(points, target, guess, photometric, coarse)
            vouched = not coarse and shared.vouch(guess)
            if vouched:
                candidate = self._hold(candidate, guess, view, points)
            if self._is_better(candidate, best, shared):
                best, reason = candidate, name
            if vouched and self._is_vouched(best) and self._explains_greys(best):
                break  # there is no better start
        if best.photometric_share > 0 and not self._explains_greys(best) and not best.degenerate:
            plain = self._align(points, target, best.T_world_camera, None, coarse=False)
            best = best if shared.prefer(best.T_world_camera, plain.T_world_camera) else plain
        return best, reason

    def _starts(self, shared: SharedFeatures) -> Iterator[tuple[str, np.ndarray, bool]]:
        """Other starts than constant velocity, the likeliest first: a name, a pose [4, 4], and whether it is coarse.
        Feature matches are good to a centimetre or two; the coarse level would slide off along a bare wall."""
        motion, tried = self.state.motion, [self.state.motion.predict()]
        turned = motion.T_world_camera @ motion.turned
        starts = [(name, pose, False) for name, pose in shared.starts()]
        starts.append(("last pose", motion.T_world_camera, True))
        if self._is_wide(turned):
            starts.append(("shift of the image", turned, True))
        for name, pose, coarse in starts:
            if not any(self._is_alike(pose, other) for other in tried):
                tried.append(pose)
                yield name, pose, coarse

    def _is_alike(self, T_one: np.ndarray, T_other: np.ndarray) -> bool:
        """Whether two starts [4, 4] lead to the same place."""
        shift = largest_shift(inverse(T_one) @ T_other, self.camera, self._median_depth or USUAL_DEPTH)
        return shift < ALIKE_SHARE * self.camera.width

    @staticmethod
    def _is_better(candidate: AlignmentResult, best: AlignmentResult, shared: SharedFeatures) -> bool:
        """Whether an alignment of the same points beats another.

        The features that the frame shares with the last ones tell poses apart that geometry and grey values alone do
        not. Where they see no difference: with grey values the joint cost decides, for sliding along a bare wall
        keeps all the overlap; without them more overlap is better, and a loose fit costs a little.
        """
        if candidate.status is AlignmentStatus.LOST or best.status is AlignmentStatus.LOST:
            return candidate.status is not AlignmentStatus.LOST
        preferred = shared.prefer(candidate.T_world_camera, best.T_world_camera)
        if preferred is not None:
            return preferred
        if candidate.photometric_share > 0 and best.photometric_share > 0:
            return candidate.cost < best.cost
        return candidate.overlap - 2.0 * candidate.rmse > best.overlap - 2.0 * best.rmse

    def _give_up(self, points: PointSource, found: AlignmentResult) -> TrackingResult:
        """Stays where it was last known, standing still."""
        self.state.motion.lose()
        self.state.still.forget()
        limit = self.settings.recovery.min_overlap
        reason = f"{found.overlap:.0%} of {len(points)} points match the map, {limit:.0%} needed, from every start"
        if found.overlap >= limit:
            reason = (
                f"only {found.overlap:.0%} of {len(points)} points match the map, and the image does not agree "
                f"(mean grey difference {found.photometric_residual:.3f} over {found.photometric_share:.0%} of it)"
            )
        if len(points) < self.settings.align.min_matches:
            reason = f"only {len(points)} points have depth, {self.settings.align.min_matches} needed"
        pose = self.state.motion.T_world_camera.copy()
        return TrackingResult(pose, TrackingStatus.LOST, found.overlap, found.rmse, reason, points, found)
