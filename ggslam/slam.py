# SPDX-License-Identifier: Apache-2.0
"""The loop: frames in, trajectory and map out.

    sequence = open_sequence("recording", scale=0.5)
    slam = Slam(sequence.camera)
    for frame in sequence.stream():
        slam.step(frame)
    result = slam.finish()
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from ggslam.config import Config
from ggslam.errors import SequenceError
from ggslam.mapping.identity import IdentityLearner
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.mapper import Mapper, MapperTimes
from ggslam.mapping.votes import vote_labels
from ggslam.native.loader import NativeContext
from ggslam.object_masks import ObjectMasks, observations
from ggslam.objects.table import Observation, Supervision
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS, IdentityClassifier
from ggslam.scene.poses import inverse
from ggslam.tracking.keyframes import KeyframePolicy
from ggslam.tracking.surface import MeasuredSurface
from ggslam.tracking.tracker import Tracker, TrackingResult, TrackingStatus


@dataclass(frozen=True)
class TrackedFrame:
    """What is remembered of every frame.

    Attributes:
        frame_index, source_index, timestamp: of the `Frame`.
        keyframe: number of the keyframe its pose hangs on.
        T_keyframe_camera: float64 [4, 4], pose relative to that keyframe, so that it moves when the keyframe moves.
        overlap: share of its points that matched the map.
        rmse_m: root mean square point-to-plane distance of the matched points, metres.
        status: outcome of tracking.
        reason: why it was lost or how it was recovered, else empty.
    """

    frame_index: int
    source_index: int
    timestamp: float
    keyframe: int
    T_keyframe_camera: np.ndarray
    overlap: float
    rmse_m: float
    status: str
    reason: str = ""


@dataclass
class StepReport:
    """What one step did, for the progress line."""

    frame: TrackedFrame
    is_keyframe: bool
    gaussians: int
    psnr: float


@dataclass
class SlamTimes:
    """Seconds of wall time.

    Attributes:
        wall: from the first step's begin to the last step's end: reading, tracking, mapping.
        tracking: spent tracking.
        refinement: spent on the final refinement, not part of `wall`.
    """

    wall: float = 0.0
    tracking: float = 0.0
    refinement: float = 0.0
    _started: float | None = None

    def start(self) -> None:
        """A step begins."""
        if self._started is None:
            self._started = time.perf_counter()

    def stop(self) -> None:
        """A step ends."""
        if self._started is not None:
            self.wall = time.perf_counter() - self._started


@dataclass(frozen=True)
class LearnedObjects:
    """Objects of a run; the Gaussians' `object_id`, `features` and votes belong to them.

    Attributes:
        classifier: of identity vectors.
        supervision: what taught them.
        observations: where each object was seen.
    """

    classifier: IdentityClassifier
    supervision: Supervision
    observations: dict[int, Observation]


@dataclass
class SlamResult:
    """A run.

    Attributes:
        gaussians: the map.
        keyframes: with refined poses.
        frames: one entry per frame, in order.
        times: seconds spent tracking and in all.
        mapper_times: seconds spent mapping, by part.
        dropped_frames: indices of frames that were not tracked (real-time runs that fell behind).
        refine_iterations: optimisation steps of the final refinement.
        objects: what was learned about objects; None if nothing was.
    """

    gaussians: GaussianMap
    keyframes: list[Keyframe]
    frames: list[TrackedFrame]
    times: SlamTimes
    mapper_times: MapperTimes
    dropped_frames: list[int] = field(default_factory=list)
    refine_iterations: int = 0
    objects: LearnedObjects | None = None

    def trajectory(self) -> np.ndarray:
        """T_world_camera of every frame, float64 [n, 4, 4], NaN for lost ones; the world is the first keyframe's
        camera."""
        poses = np.full((len(self.frames), 4, 4), np.nan)
        for pose, f in zip(poses, self.frames, strict=True):
            # A keyframe may be missing if a real-time run stopped before its mapper had taken it in.
            if f.status != TrackingStatus.LOST.value and f.keyframe < len(self.keyframes):
                pose[:] = self.keyframes[f.keyframe].T_world_camera @ f.T_keyframe_camera
        return poses

    def timestamps(self) -> np.ndarray:
        """Seconds, float64 [n]."""
        return np.array([f.timestamp for f in self.frames])

    def frames_per_second(self) -> float:
        """Frames by wall time, reading the recording included, final refinement and scoring not."""
        return len(self.frames) / self.times.wall if self.times.wall > 0 else float("nan")


@dataclass(frozen=True)
class Anchor:
    """The keyframe that poses are remembered relative to, and its pose as tracked."""

    keyframe: int
    T_world_camera: np.ndarray


class Slam:
    """Synchronous SLAM: each step tracks one frame, maybe makes a keyframe of it, and trains the map a fixed number
    of iterations. Deterministic for a given configuration and machine.

    Args:
        camera: of all frames.
        config: all settings.
        has_masks: whether the recording has object masks; None: judged by the first keyframe's frame.
    """

    def __init__(self, camera: Camera, config: Config | None = None, has_masks: bool | None = None) -> None:
        self.camera = camera
        self.config = config or Config()
        self.context = NativeContext(self.config.threads or None)
        self.masks = ObjectMasks(self.config.masks, has_masks)
        wanted = self.config.identity.enabled and self.masks.active
        learner = IdentityLearner(self.config.identity, self.config.seed) if wanted else None
        self.map = GaussianMap(self.config.sh_degree, IDENTITY_CHANNELS if learner else 0)
        self.tracker = Tracker(camera, self.config.tracking, self.context)
        self.surface = MeasuredSurface(self.config.tracking.target, self.context)
        self.policy = KeyframePolicy(self.config.keyframes)
        self.mapper = Mapper(self.map, self.config.mapping, self.context, self.config.seed, learner)
        self.frames: list[TrackedFrame] = []
        self.dropped_frames: list[int] = []
        self.refine_iterations = 0
        self.times = SlamTimes()
        self._anchor = Anchor(-1, np.eye(4))
        self._settled = False
        self._objects: LearnedObjects | None = None

    # --- the loop ----------------------------------------------------------------------------------------------------

    def step(self, frame: Frame) -> StepReport:
        """Track, maybe insert a keyframe, train.

        Raises:
            SequenceError: the frame's images do not fit the camera.
        """
        self.times.start()
        tracking = self.track(frame)
        is_keyframe = self.wants_keyframe(frame, tracking)
        if is_keyframe:
            self.insert(frame, tracking)
            self.anchor_to(tracking.T_world_camera)
        self.remember(frame, tracking)
        if self.mapper.keyframes:
            first = is_keyframe and len(self.mapper.keyframes) == 1
            settings = self.config.mapping
            self.mapper.run(settings.first_frame_iterations if first else settings.iterations_per_frame)
        self.times.stop()
        return StepReport(self.frames[-1], is_keyframe, self.map.count, self.mapper.last_psnr)

    def finish(self, progress: Callable[[int, int], None] | None = None) -> SlamResult:
        """Final refinement (`refine_iterations`), then the result. `progress(done, total)` is called now and then."""
        start, before = time.perf_counter(), self.mapper.times.iterations
        try:
            if self.config.refine_iterations and self.mapper.keyframes:
                self.mapper.refine(self.config.refine_iterations, progress)
        finally:  # an interrupted refinement counts for what it did
            self.refine_iterations = self.mapper.times.iterations - before
            self.times.refinement = time.perf_counter() - start
        return self.result()

    def result(self) -> SlamResult:
        """What there is so far. The first call settles the objects: it is for the end."""
        return SlamResult(
            self.map, self.mapper.keyframes, self.frames, self.times, self.mapper.times, self.dropped_frames,
            self.refine_iterations, self._learned_objects(),
        )  # fmt: skip

    def _learned_objects(self) -> LearnedObjects | None:
        """The last identity steps, and every Gaussian's object; once."""
        identity = self.mapper.identity
        if self._settled or identity is None or not identity.table.count:
            return self._objects
        self._settled = True  # if it fails below, the map can still be had by another call
        seen = observations(self.mapper.keyframes, identity.current)
        sizes = np.bincount(vote_labels(self.map), minlength=65536)
        noise = self.masks.noise(identity.classifier.class_ids, seen, len(self.mapper.keyframes), sizes)
        identity.forget(self.map, noise)
        self.mapper.finish_identity()
        kept = {i: observation for i, observation in seen.items() if i not in noise}
        self._objects = LearnedObjects(identity.classifier, self.masks.supervision, kept)
        return self._objects

    # --- its parts, also used by the real-time loop ------------------------------------------------------------------

    def track(self, frame: Frame) -> TrackingResult:
        """Locates one frame against the current target.

        Raises:
            SequenceError: images of another size than the camera's, or of another type than `Frame` says.
        """
        check_frame(frame, self.camera)
        start = time.perf_counter()
        result = self.tracker.track(frame)
        if not self.mapper.keyframes and self.tracker.noise is not None:
            self.mapper.depth_sigma = self.tracker.noise.sigma(result.median_depth_m)
        self.times.tracking += time.perf_counter() - start
        return result

    def wants_keyframe(self, frame: Frame, tracking: TrackingResult) -> bool:
        """Whether the frame becomes a keyframe: never when lost, and never when held out for scoring (but something
        has to be the first)."""
        held_out = self.policy.kind is not None and self.config.evaluation.is_held_out(frame.index)
        if held_out or tracking.status is TrackingStatus.LOST:
            return False
        return self.policy.decide(frame.index, tracking)

    def insert(self, frame: Frame, tracking: TrackingResult) -> None:
        """A keyframe goes into the map and into what the tracker aligns to."""
        self.mapper.add_keyframe(frame, tracking.T_world_camera, partial(self.masks.labels, frame))
        self.tracker.set_target(self.surface.add(tracking.points, tracking.T_world_camera))

    def anchor_to(self, T_world_camera: np.ndarray) -> None:
        """From now on poses are remembered relative to this keyframe."""
        self._anchor = Anchor(self._anchor.keyframe + 1, T_world_camera.copy())

    def remember(self, frame: Frame, tracking: TrackingResult) -> None:
        """Notes the pose of a frame relative to the newest keyframe."""
        T_keyframe_camera = inverse(self._anchor.T_world_camera) @ tracking.T_world_camera
        self.frames.append(
            TrackedFrame(
                frame.index, frame.source_index, frame.timestamp, max(0, self._anchor.keyframe), T_keyframe_camera,
                tracking.overlap, tracking.rmse_m, tracking.status.value, tracking.reason,
            )
        )  # fmt: skip


def check_frame(frame: Frame, camera: Camera) -> None:
    """Raises SequenceError unless the frame's images have the camera's size and the types that `Frame` promises."""
    size = (camera.height, camera.width)
    for name, image, shape, kind in (("colour", frame.color, (*size, 3), "u1"), ("depth", frame.depth, size, "f4")):
        if image.shape[:2] != size:
            found = "x".join(str(n) for n in image.shape[1::-1])
            expected = f"{camera.width}x{camera.height}"
            raise SequenceError(f"frame {frame.source_index}: {name} is {found}, expected {expected}")
        if image.shape != shape or image.dtype != np.dtype(kind):
            found = f"{image.dtype} {list(image.shape)}"
            raise SequenceError(
                f"frame {frame.source_index}: {name} is {found}, expected {np.dtype(kind)} {list(shape)}"
            )
    if not (frame.depth >= 0).all() or not np.isfinite(frame.depth).all():
        raise SequenceError(f"frame {frame.source_index}: depth has negative, infinite or NaN values; 0 means none")
