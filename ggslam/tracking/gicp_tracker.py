# SPDX-License-Identifier: Apache-2.0
"""The tracker that aligns frames by G-ICP and recovers when the camera is lost."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from ggslam.features.orb import FeatureView
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import orthonormalize
from ggslam.system.plurals import quantity
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning
from ggslam.tracking.engine import CpuTrackingEngine, TrackingEngine
from ggslam.tracking.gicp import AlignmentResult, AlignmentStatus, GicpTarget, PhotometricPart, PhotometricSource
from ggslam.tracking.noise import estimate_noise
from ggslam.tracking.photometric import GreyDepth, PhotometricReference, textured_points
from ggslam.tracking.points import PointSource
from ggslam.tracking.pose_judge import JudgeTuning, PoseJudge
from ggslam.tracking.settings import DepthNoise, PhotometricMode, TrackerSettings
from ggslam.tracking.still_camera import SmallFrame
from ggslam.tracking.tracker import Tracker, TrackerState, TrackingResult, TrackingStatus


class GicpTrackerTuning(Tuning):
    """When photometric alignment is used."""

    min_textured = 200
    """Fewest textured points for photometric alignment."""


@savable(not_saved="_given_engine")
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

    _median_depth: float | None

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
        self._median_depth = None

    @classmethod
    def with_state(cls, state: TrackerState, engine: TrackingEngine | None = None) -> GicpTracker:
        """A tracker that works with the state of another; `engine` as of the constructor."""
        tracker = cls(state.camera, state.settings, state.context, engine=engine)
        tracker.state = state
        return tracker

    @property
    def engine(self) -> TrackingEngine:
        """Where points are extracted and aligned."""
        return self._given_engine or CpuTrackingEngine(self.camera, self.context)

    @engine.setter
    def engine(self, engine: TrackingEngine) -> None:
        self._given_engine = engine

    def expect_target(self, target: GicpTarget) -> None:
        """See `Tracker.expect_target`."""
        self.engine.expect_target(target)

    def track(self, frame: Frame) -> TrackingResult:
        """See `Tracker.track`."""
        state = self.state
        target, motion = state.target, state.motion
        if state.noise is None:
            state.noise = estimate_noise(frame.depth, state.camera)
        noise = state.noise or DepthNoise()
        points = self._points(frame.depth, noise)
        motion.wary = max(0, motion.wary - 1)
        view = FeatureView(frame.color, frame.depth, motion.T_world_camera)
        motion.watch(frame.color, state.camera)
        small, still = SmallFrame.of(frame.color, frame.depth), state.still
        if target is None:
            still.renew(small, motion.T_world_camera)
            return self._begin(view, points)
        state.noise = noise  # what could not be measured before the first keyframe is taken as usual
        if not motion.lost and still.holds(small, noise):
            stayed = self._stay(view, points, target)
            if stayed is not None:
                return stayed
        judge, found, reason = self._locate(view, points, target)
        if not motion.wary and found.photometric_share > 0 and motion.is_sudden(found.photometric_residual):
            motion.wary = state.settings.recovery.wary_frames
            points = self._points(frame.depth, noise)
            judge, found, reason = self._locate(view, points, target)
        if not judge.is_acceptable(found, points):
            return self._give_up(points, found)
        T = orthonormalize(found.T_world_camera)
        self._look_at_residuals(points, found)
        doubt = judge.jump(T)
        still.renew(small, T)
        motion.follow(view, T)
        if found.photometric_share > 0:
            motion.note_greys(found.photometric_residual)
        motion.remember(view, points, state.settings)
        status = TrackingStatus.DEGENERATE if found.degenerate else TrackingStatus.OK
        status = TrackingStatus.RECOVERED if reason else status
        if doubt:
            status, reason = TrackingStatus.DOUBTED, f"only {doubt}"
        return TrackingResult.by_gicp(T.copy(), status, reason, points, found)

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
        return TrackingResult.by_gicp(T.copy(), TrackingStatus.OK, "", points, held, still=True)

    def _points(self, depth: np.ndarray, noise: DepthNoise) -> PointSource:
        state = self.state
        settings = state.settings.points
        if state.motion.wary:
            near = min(settings.near_weight, state.settings.recovery.near_weight)
            settings = dataclasses.replace(settings, near_weight=near)
        points = (self._given_engine or self.engine).points(depth, settings, noise)
        if state.settings.noise is None and state.residuals.will_be_due():
            points.expect_look()
        return points

    def _look_at_residuals(self, points: PointSource, found: AlignmentResult) -> None:
        """Noise that was measured on the first frame is taken to be larger where frames do not lie on one another."""
        state = self.state
        if state.settings.noise is None and state.noise is not None and state.residuals.due():
            state.noise = state.residuals.observe_medians(found.matches.medians(points), state.noise)

    def _locate(
        self, view: FeatureView, points: PointSource, target: GicpTarget
    ) -> tuple[PoseJudge, AlignmentResult, str]:
        """The best alignment, which start it came from (empty: constant velocity, or features after a wide step), and
        who judged it."""
        state, known = self.state, points.median_depth_if_known()
        expected = self._median_depth if known is None else known
        mode = self._mode(points.median_depth if expected is None else expected)
        near = JudgeTuning.near_m
        depth_m = min(expected or near, near)
        judge = PoseJudge(view, state.motion, state.camera, state.settings.recovery, depth_m)
        found = self._locate_by(mode, judge, points, target)
        self._median_depth = depth = points.median_depth
        if known is None:  # it is known now, and seldom so far from the frame's before that the mode is another one
            actual = self._mode(depth)
            found = found if actual == mode else self._locate_by(actual, judge, points, target)
        return judge, *found

    def _locate_by(
        self, mode: PhotometricMode, judge: PoseJudge, points: PointSource, target: GicpTarget
    ) -> tuple[AlignmentResult, str]:
        """As `_locate`, in a photometric mode."""
        guess, coarse = judge.first_start()
        photometric = self._photometric_part(judge.view) if mode == "always" or self.state.motion.lost else None
        found = self._align_held(judge, points, target, guess, photometric, coarse)
        photometric = _with_texture(photometric)
        if photometric is not None and not judge.explains_greys(found) and not found.degenerate:
            # Images that do not agree (too far apart, shutters out of step) must not pull at good geometry.
            found = self._align(points, target, guess, None, coarse)
            if judge.features.contradict(found.T_world_camera):
                return self._retry(judge, points, target, found, photometric)
        if photometric is None and found.degenerate and mode != "never":
            photometric = self._photometric_part(judge.view)
            if photometric is not None:
                found = self._align_held(judge, points, target, guess, photometric, coarse)
                photometric = _with_texture(photometric)
        sure = mode == "never" or not found.degenerate or judge.explains_greys(found)
        if sure and judge.is_convincing(found) and not judge.is_far_off(found):
            return found, ""
        if not coarse and judge.is_vouched(found):
            return found, ""
        return self._retry(judge, points, target, found, photometric)

    def _align_held(
        self, judge: PoseJudge, points: PointSource, target: GicpTarget, guess: np.ndarray,
        photometric: PhotometricSource | None, coarse: bool,
    ) -> AlignmentResult:  # fmt: skip
        """An alignment, held to the features that vouch for its start unless that is `coarse`."""
        found = self._align(points, target, guess, photometric, coarse)
        return found if coarse else judge.hold(found, guess, points, self._noise())

    def _mode(self, median_depth: float) -> PhotometricMode:
        """The photometric mode with "auto" decided."""
        state, settings = self.state, self.state.settings.photometric
        if settings.mode != "auto":
            return settings.mode
        assert state.noise is not None
        noise = state.noise.sigma(median_depth)
        if state.settings.noise is None:  # smooth depth may be wrong: it is trusted once residuals have shown its error
            shown = state.residuals.sigma
            noise = math.inf if shown is None else max(shown, noise)
        return "always" if noise > settings.noisy_m else "degenerate"

    def _align(
        self, points: PointSource, target: GicpTarget, guess: np.ndarray, photometric: PhotometricSource | None,
        coarse: bool = True,
    ) -> AlignmentResult:  # fmt: skip
        settings, noise = self.state.settings.align, self.state.noise
        assert noise is not None
        if not coarse:
            settings = dataclasses.replace(settings, coarse_iterations=0)
        return (self._given_engine or self.engine).align(points, target, guess, settings, noise, photometric)

    def _noise(self) -> DepthNoise:
        assert self.noise is not None
        return self.noise

    def _photometric_part(self, view: FeatureView) -> PhotometricSource | None:
        """Textured points of the view and the reference; None without either, as far as is known."""
        state, greys, least = self.state, (self._given_engine or self.engine).greys, GicpTrackerTuning.min_textured
        settings, earlier = state.settings.photometric, state.motion.reference_view
        if greys is not None:
            return None if earlier is None else greys.part(view, earlier, settings, self._shrink_factor(), least)
        reference = self._current_reference()
        if reference is None:
            return None
        points = textured_points(self._shrink(view), settings)
        return PhotometricPart(points, reference, settings) if len(points) >= least else None

    def _current_reference(self) -> PhotometricReference | None:
        motion = self.state.motion
        if motion.reference is None and motion.reference_view is not None:
            view = motion.reference_view
            motion.reference = PhotometricReference.from_view(self._shrink(view), view.T_world_camera)
        return motion.reference

    def _shrink_factor(self) -> int:
        """By how much images are reduced for their grey values."""
        return self.state.settings.photometric.shrink * max(1, round(self.state.camera.width / 320))

    def _shrink(self, view: FeatureView) -> GreyDepth:
        return GreyDepth.from_images(view.color, view.depth, self.camera, self._shrink_factor())

    def _retry(
        self, judge: PoseJudge, points: PointSource, target: GicpTarget, found: AlignmentResult,
        photometric: PhotometricSource | None,
    ) -> tuple[AlignmentResult, str]:  # fmt: skip
        """The best alignment over all starts."""
        photometric = photometric or self._photometric_part(judge.view)
        best, reason = found, ""
        if photometric is not None and found.photometric_share == 0:  # all starts are compared by the same measure
            best = self._align(points, target, self.state.motion.predict(), photometric)
            photometric = _with_texture(photometric)
            best = found if photometric is None else best
        for name, guess, coarse in judge.other_starts():
            candidate = self._align(points, target, guess, photometric, coarse)
            vouched = not coarse and judge.features.vouch(guess)
            if vouched:
                candidate = judge.hold(candidate, guess, points, self._noise())
            if judge.is_better(candidate, best):
                best, reason = candidate, name
            if vouched and judge.is_vouched(best) and judge.explains_greys(best):
                break  # there is no better start
        if best.photometric_share > 0 and not judge.explains_greys(best) and not best.degenerate:
            plain = self._align(points, target, best.T_world_camera, None, coarse=False)
            best = best if judge.features.prefer(best.T_world_camera, plain.T_world_camera) else plain
        return best, reason

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
            needed = self.settings.align.min_matches
            reason = f"only {quantity(len(points), 'point has', 'points have')} depth, {needed} needed"
        pose = self.state.motion.T_world_camera.copy()
        return TrackingResult.by_gicp(pose, TrackingStatus.LOST, reason, points, found)


def _with_texture(part: PhotometricSource | None) -> PhotometricSource | None:
    """The part, unless an alignment has told that it has not enough texture."""
    return part if part is not None and part.has_texture else None
