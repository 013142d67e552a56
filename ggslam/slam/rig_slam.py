# SPDX-License-Identifier: Apache-2.0
"""The loop for a rig of cameras: all frames of an instant at a time, located as one body, mapped each by itself."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ggslam.errors import ConfigError, FormatError
from ggslam.features.orb import FeatureView
from ggslam.geometry.scene_size import scene_scale
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.frame_checks import check_frame
from ggslam.scene.poses import inverse
from ggslam.scene.rig import Rig
from ggslam.slam.config import Config
from ggslam.slam.depth_edges import DepthEdges
from ggslam.slam.loop_settings import LoopSettings
from ggslam.slam.result import StepReport
from ggslam.slam.rig_clock import RigClock
from ggslam.slam.shutter_times import ShutterTimes
from ggslam.slam.slam import TRIM_EVERY, Slam
from ggslam.system.opencv import opencv_errors
from ggslam.system.process_memory import trim
from ggslam.system.savable import savable
from ggslam.tracking.gicp_tracker import GicpTracker
from ggslam.tracking.noise import estimate_noise
from ggslam.tracking.rig_engine import RigTrackingEngine, RigView
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

DARK = 12
"""Grey levels of 255: an image that is nowhere brighter shows nothing."""
DARK_LOOK = 8
"""Every so many rows and columns are looked at."""


@dataclass(frozen=True)
class _Located:
    """The frames of an instant: where their rig is, and where each of them is."""

    frames: list[Frame]
    joint: TrackingResult
    tracked: list[TrackingResult]


@savable(not_saved="camera rig config context pager _notes _on_device _engine", after="use_scale_again", check="check")
class RigSlam(Slam):
    """See `Slam`. `step_together` takes the frames of all cameras of a rig at one instant; the points of all of them
    are aligned at once. Every frame has a pose and may be a keyframe; the keyframes of an instant keep to one another
    as the rig has them. A camera that sees nothing, or has no frame at an instant, is carried along by the others.

    Args:
        rig: the cameras.
        config: all settings.
        has_masks: as of `Slam`.

    Raises:
        ConfigError: settings that a rig does not go with.
    """

    _edges_of: list[DepthEdges]
    _shutters_of: list[ShutterTimes]

    def __init__(self, rig: Rig, config: Config | None = None, has_masks: bool | None = None) -> None:
        settings = _settings_for(rig, config or Config())
        super().__init__(rig.cameras[0], settings, has_masks)
        assert isinstance(self.tracker, GicpTracker)
        self.rig, self.config = rig, config or Config()
        self._engine = RigTrackingEngine(self.context)
        self.tracker.engine = self._engine
        self._clock = RigClock()
        self._edges_of, self._shutters_of = [DepthEdges() for _ in rig.names], [ShutterTimes() for _ in rig.names]

    def check(self) -> None:
        """Raises FormatError if it has not what it must have of each camera: its state may come from a file."""
        for kept in (self._edges_of, self._shutters_of):
            if len(kept) != len(self.rig.names):
                raise FormatError(f"cameras: expected {len(self.rig.names)}, found the state of {len(kept)}")

    def step(self, frame: Frame) -> StepReport:
        """An instant of which there is one frame only; see `step_together`."""
        return self.step_together([frame])[0]

    def step_together(self, frames: Sequence[Frame]) -> list[StepReport]:
        """Track the frames of one instant, maybe insert keyframes, train.

        Args:
            frames: of different cameras of the rig; `Frame.camera_number` and `Frame.instant` say which and when.

        Returns:
            What the step did, for each frame; what it took besides its length is the first one's.

        Raises:
            SequenceError: a frame is of another camera, or not what `Frame` says.
            OpenCvError: OpenCV refused its images.
        """
        with opencv_errors(f"frame {frames[0].index}"):
            return self._step_together(frames)

    def _step_together(self, frames: Sequence[Frame]) -> list[StepReport]:
        start = time.perf_counter()
        self.times.start()
        found = self._track_together([self.receive(frame) for frame in frames])
        chosen = self._choose_keyframes(found)
        before = len(self.mapper.keyframes)
        if chosen:
            self.tracker.target = None  # see `Slam.step`
        for k in chosen:
            self.insert(found.frames[k], found.tracked[k], self.moves_followed)
            self.poses.add_keyframe(found.tracked[k].T_world_camera)
        for frame, tracking in zip(found.frames, found.tracked, strict=True):
            self.poses.add(frame, tracking)
        self._train(len(frames), before)
        self.times.stop()
        seconds = (time.perf_counter() - start) / len(frames)
        return [self.note_step(k in chosen, seconds, k - len(frames)) for k in range(len(frames))]

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """See `Slam`."""
        return self.rig.cameras

    # --- parts -------------------------------------------------------------------------------------------------------

    def receive(self, frame: Frame) -> Frame:
        """See `Slam.receive`."""
        number = frame.camera_number
        check_frame(frame, self.rig.cameras[number])
        return self._shutters_of[number].bring(self._edges_of[number].clean(frame))

    def _track_together(self, frames: list[Frame]) -> _Located:
        """Where the rig and each of the frames is."""
        start, now = time.perf_counter(), frames[0].timestamp
        self._follow_moves()
        for frame in frames:
            self.mapper.note_valid(frame)
        if not len(self.surface):
            self.use_scale(scene_scale(np.concatenate([frame.depth.reshape(-1) for frame in frames])))
        self._engine.views = [RigView(f.camera, f.depth, self._T_first_of(f, now)) for f in frames]
        joint = self._locate(frames, self._lead(frames))
        lost = joint.status is TrackingStatus.LOST
        self._clock.follow(None if lost else joint.T_world_camera, now)
        self._tell_noise(joint.median_depth_m)
        tracked = self._of_frames(frames, joint, now)
        for frame, tracking in zip(frames, tracked, strict=True):
            self._shutters_of[frame.camera_number].follow(None if lost else tracking.T_world_camera)
        seconds = time.perf_counter() - start
        self.times.tracking_by_frame += [seconds / len(frames)] * len(frames)
        self.times.tracking += seconds
        return _Located(frames, joint, tracked)

    def _locate(self, frames: list[Frame], lead: Frame) -> TrackingResult:
        """Where the rig is; one that is lost is looked up among all keyframes."""
        if self.tracker.noise is None and not lead.depth.any():
            told = (estimate_noise(frame.depth, frame.camera) for frame in frames)
            self.tracker.noise = next((noise for noise in told if noise is not None), None)
        joint = self.tracker.track(lead)
        if joint.status is not TrackingStatus.LOST or self.loops is None or self.tracker.target is None:
            return joint
        now = frames[0].timestamp
        for frame, part in zip(frames, self._engine.parts, strict=True):
            T_first_camera = self._T_first_of(frame, now)
            T_lost = joint.T_world_camera @ T_first_camera
            found = self.loops.find(frame, replace(joint, points=part, T_world_camera=T_lost))
            if found is not None:
                result, keyframe = found
                self.poses.anchor_to(keyframe, self.loops.poses[keyframe])
                T = result.T_world_camera @ inverse(T_first_camera)
                view, motion = FeatureView(lead.color, lead.depth, T), self.tracker.state.motion
                motion.restart(view, T)
                motion.remember(view, joint.points, self.tracker.settings)
                return replace(result, T_world_camera=T, points=joint.points)
        return joint

    def _T_first_of(self, frame: Frame, now: float) -> np.ndarray:
        """From a frame's camera to the first one's as it was at a time, seconds."""
        return self._clock.motion_in(frame.timestamp - now) @ self.rig.T_first_camera[frame.camera_number]

    def _lead(self, frames: list[Frame]) -> Frame:
        """The first camera's frame; where that shows nothing, one without anything."""
        lead = frames[0]
        if lead.camera_number == 0 and not _is_black(lead):
            return lead
        size = (self.camera.height, self.camera.width)
        return replace(lead, color=np.zeros((*size, 3), np.uint8), depth=np.zeros(size, np.float32), camera=self.camera)

    def _of_frames(self, frames: list[Frame], joint: TrackingResult, now: float) -> list[TrackingResult]:
        """The same for each of the frames: its pose, its own points, and how well they fit."""
        parts, shares = self._engine.parts, list[float | None]([None] * len(frames))
        if joint.gicp is not None and len(joint.gicp.matches.read().voxels) == sum(map(len, parts)):
            noise = self.tracker.noise or DepthNoise()
            shares = self._engine.overlaps(joint.gicp, self.tracker.settings.align, noise)
        return [
            replace(
                joint, points=part, overlap=joint.overlap if share is None else share,
                T_world_camera=joint.T_world_camera @ self._T_first_of(frame, now),
            ) for frame, part, share in zip(frames, parts, shares, strict=True)
        ]  # fmt: skip

    def _choose_keyframes(self, found: _Located) -> list[int]:
        """Which of the frames become keyframes: all that show something, or none. As with one camera, none of an
        instant that is lost or held out for scoring."""
        frames, now, instant = found.frames, found.frames[0].timestamp, _instant(found.frames[0])
        held_out = self.policy.kind is not None and self.config.evaluation.is_held_out(instant)
        if held_out or found.joint.status is TrackingStatus.LOST or not self.growing:
            return []
        needed, black = self.tracker.settings.align.min_matches, [_is_black(frame) for frame in frames]
        chosen = [
            k for k, frame in enumerate(frames)
            if len(found.tracked[k].points) >= needed and self._clock.knows(frame.timestamp - now)
            and (not black[k] or all(black))
        ]  # fmt: skip
        if not chosen:
            return []
        least = min(found.tracked[k].overlap for k in chosen)
        return chosen if self.policy.decide(instant, replace(found.joint, overlap=least)) else []

    def _train(self, frames: int, before: int) -> None:
        """The training of an instant of so many frames, before which there were so many keyframes."""
        count, settings = len(self.mapper.keyframes), self.config.mapping
        if count // TRIM_EVERY != before // TRIM_EVERY:
            trim()
        if count and self.growing:
            first = settings.first_frame_iterations * count
            self.mapper.run(settings.iterations_per_frame * frames if before else first)


def _instant(frame: Frame) -> int:
    return frame.index if frame.instant is None else frame.instant


def _is_black(frame: Frame) -> bool:
    """Whether an image shows nothing."""
    return int(frame.color[::DARK_LOOK, ::DARK_LOOK].max()) <= DARK


def _settings_for(rig: Rig, config: Config) -> Config:
    """The settings as the parts of a rig's run use them: what counts keyframes counts those of all cameras.

    Raises:
        ConfigError: settings that a rig does not go with.
    """
    refusals = {
        "realtime_fps": config.realtime_fps > 0, "memory_limit_mb": config.memory_limit_mb > 0,
        "device": config.device == "cuda", "tracker": config.tracker != "gicp",
    }  # fmt: skip
    refused = [name for name, is_refused in refusals.items() if is_refused]
    if refused:
        value = getattr(config, refused[0])
        raise ConfigError(f"{refused[0]}: a rig of cameras does not go with {value}; runs of a rig are synchronous, on "
                          "the CPU, tracked by G-ICP, with all of the map in memory")  # fmt: skip
    movers = replace(config.movers, enabled=False)  # frames of different cameras follow one another
    return replace(config, device="cpu", loops=_loops_for(len(rig), config.loops), movers=movers)


def _loops_for(cameras: int, loops: LoopSettings) -> LoopSettings:
    n, activity, revisits = cameras, loops.activity, loops.revisits
    return replace(
        loops, confirmation_gap=n * loops.confirmation_gap, neighbourhood=min(1000, n * loops.neighbourhood),
        activity=replace(activity, batch=n * activity.batch, spread=n * activity.spread, most=n * activity.most),
        revisits=replace(revisits, gap=n * revisits.gap, rest=n * revisits.rest),
    )  # fmt: skip
