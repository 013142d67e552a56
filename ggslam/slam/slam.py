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
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import ConfigError
from ggslam.features.orb import FeatureView
from ggslam.geometry.scene_size import scene_scale
from ggslam.mapping.extra_loss import ExtraLoss
from ggslam.mapping.keyframe import Keyframe
from ggslam.mapping.scale import scale_settings as scale_mapping
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.frame_checks import check_frame
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS
from ggslam.slam.camera_fixtures import CameraFixtures
from ggslam.slam.color_poses import ColorPoses
from ggslam.slam.config import Config
from ggslam.slam.depth_edges import DepthEdges
from ggslam.slam.earlier_views import EarlierViews
from ggslam.slam.frame_poses import FramePoses
from ggslam.slam.left_parts import LeftParts
from ggslam.slam.loop_closing import LoopCloser
from ggslam.slam.map_corrections import MapCorrections
from ggslam.slam.map_parts import MapParts
from ggslam.slam.part_start import PartStart, pose_apart
from ggslam.slam.parts import check_arguments, device_name, make_parts
from ggslam.slam.result import LearnedObjects, SlamResult, SlamTimes, StepReport, TrackedFrame
from ggslam.slam.run_movers import RunMovers
from ggslam.slam.run_objects import RunObjects
from ggslam.slam.saved_places import saved_places_to_bytes
from ggslam.slam.shutter_times import ShutterTimes
from ggslam.slam.step_log import StepLog
from ggslam.submaps.gaussian_cells import GaussianCells
from ggslam.system.opencv import opencv_errors
from ggslam.system.process_memory import trim
from ggslam.system.savable import savable
from ggslam.tracking.keyframes import KeyframePolicy
from ggslam.tracking.scale import scale_settings
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.still_camera import still_notes
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

TRIM_EVERY = 8
"""Keyframes: the C library keeps a fifth of a run's memory for itself that once held arrays; asking for it back takes
milliseconds."""


@savable(not_saved="camera config context pager _notes _on_device", after="use_scale_again")
class Slam:
    """Synchronous SLAM: each step tracks one frame, maybe makes a keyframe of it, and trains the map a fixed number
    of iterations. Deterministic for a given configuration and machine.

    Args:
        camera: of all frames.
        config: all settings.
        has_masks: whether the recording has object masks; None: judged by the first keyframe's frame.
        paging: folder that what does not fit into `memory_limit_mb` moves to; None: a temporary one.
        library: CUDA kernels to compute with; None: as `config.device` says.
        extra_loss: a loss of one's own in every mapping iteration, extra_loss(view, keyframe) -> scalar tensor, see
            `mapping.extra_loss.ExtraLoss`; on the CPU only.

    Raises:
        InputError: a camera, settings or an extra loss that are none.
        ConfigError: a limit of memory that is less than the program itself takes; no such device; an extra loss on a
            GPU.
    """

    scale: float
    _noise: DepthNoise | None
    dropped_frames: list[int]
    _early: list[tuple[Frame, TrackingResult]]
    refine_iterations: int

    def __init__(
        self, camera: Camera, config: Config | None = None, has_masks: bool | None = None, paging: Path | None = None,
        library: CudaLibrary | None = None, extra_loss: ExtraLoss | None = None,
    ) -> None:  # fmt: skip
        check_arguments(camera, config, extra_loss)
        self.camera = camera
        self.config = config or Config()
        parts = make_parts(camera, self.config, has_masks, paging, library, compact=extra_loss is None)
        self.context, self.masks, self.tracker, self.surface = parts.context, parts.masks, parts.tracker, parts.surface
        self.mapper, self.pager, self.loops = parts.mapper, parts.pager, parts.loops
        self._notes, self._on_device = parts.notes, parts.on_device
        if extra_loss is not None and self._on_device:
            raise ConfigError("a loss of your own (extra_loss) needs device: cpu; on a GPU kernels compute the losses")
        self.mapper.extra_loss = extra_loss
        self.policy = KeyframePolicy(self.config.keyframes)
        self.scale = 1.0
        """Size of the scene against a room's, see `geometry.scene_size`."""
        self.poses = FramePoses()
        self.dropped_frames = []
        self.refine_iterations = 0
        self.times = SlamTimes()
        self.steps = StepLog()
        self.growing = True
        """Whether keyframes are made and the map is trained; off: frames are located in the map as it is."""
        self._corrections = MapCorrections(self.surface, self.mapper, self.pager, self.masks)
        self._parts = MapParts(self.mapper, self.poses, self._corrections, self.loops)
        self._moves_followed = 0
        self._noise = None
        self._objects = RunObjects(self.masks)
        self.color_poses = ColorPoses(self.mapper, self.poses, self.tracker.state)
        self._depth_edges, self._shutters, self._fixtures = DepthEdges(), ShutterTimes(), CameraFixtures()
        self.earlier_views = EarlierViews()
        self.part_start, self.left_parts = PartStart(), LeftParts()
        self._early = []
        self.takes_keyframes = True
        """Whether the next keyframe would be taken now; in real time none is while too many wait."""
        self.movers = RunMovers(self.config.movers, self.config.masks.source in ("auto", "recording"), self.context)

    def adopt(self, gaussians: GaussianMap, keyframes: list[Keyframe], objects: LearnedObjects | None) -> None:
        """Starts in a map made before; `surface` and `loops` hold its keyframes already. The camera counts as lost
        until `loops` finds it.

        Args:
            gaussians: the map.
            keyframes: its keyframes.
            objects: its objects.

        Raises:
            ConfigError: memory is limited, and maps made before are taken whole.
        """
        if self.pager is not None:
            raise ConfigError("memory_limit_mb: a run that starts in the map of another (`map`) has no limit of memory")
        self._objects.learned, self.poses.keyframes_made = objects, len(keyframes)
        self.mapper.adopt(gaussians, keyframes)
        if objects is None or gaussians.feature_channels != IDENTITY_CHANNELS:
            self.mapper.identity = None
        elif self.mapper.identity is not None:
            self.mapper.identity.resume(objects.classifier)
        assert self.surface.target is not None
        self.tracker.start_lost(self.surface.target)

    # --- the loop ----------------------------------------------------------------------------------------------------

    def step(self, frame: Frame) -> StepReport:
        """Track, maybe insert a keyframe, train.

        Raises:
            SequenceError: the frame is of another camera, or not what `Frame` says.
        OpenCvError: OpenCV refused its images.
        """
        with opencv_errors(f"frame {frame.index}"):
            return self._step(frame)

    def _step(self, frame: Frame) -> StepReport:
        start = time.perf_counter()
        self.times.start()
        frame = self.receive(frame)
        tracking = self.track(frame)
        frame = self.without_movers(frame)
        for early in self.take_early():
            self.insert(*early, self.moves_followed)
        is_keyframe = self.wants_keyframe(frame, tracking)
        if is_keyframe:
            self.tracker.target = None  # the surface may be made anew; the next frame gets what it is then
            if self._on_device:
                self._insert_beside_training(frame, tracking)
            else:
                self.insert(frame, tracking, self.moves_followed)
            self.poses.add_keyframe(tracking.T_world_camera)
            if len(self.mapper.keyframes) % TRIM_EVERY == 0:
                trim()
        self.poses.add(frame, tracking)
        if not (is_keyframe and self._on_device):
            self._train_step(is_keyframe)
        if not is_keyframe:
            self.color_poses.note(frame, tracking)
        self.times.stop()
        seconds = time.perf_counter() - start
        return self.note_step(is_keyframe, seconds)

    @property
    def frames(self) -> list[TrackedFrame]:
        """How each frame so far was tracked."""
        return self.poses.frames

    @property
    def map(self) -> GaussianMap:
        """As trained so far; on the device that it is trained on."""
        return self.mapper.map

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Of the frames, by `Frame.camera_number`."""
        return (self.camera,)

    def note_step(self, is_keyframe: bool, seconds: float, number: int = -1) -> StepReport:
        """What the step did that has just ended with frame `number` of `frames` and took `seconds`; `steps` remembers
        it."""
        loops_s = 0.0 if self.loops is None else self.loops.seconds
        frame = self.frames[number]
        report = self.steps.add(frame, is_keyframe, seconds, self.times, loops_s, self.mapper, self.gaussian_count)
        if frame.status != TrackingStatus.LOST.value:
            report.T_world_camera = self.poses.as_tracked(frame)
        return report

    @property
    def gaussian_count(self) -> int:
        """Gaussians of the map, in memory and on disk."""
        return self.map.count + (0 if self.pager is None else self.pager.on_disk)

    @property
    def refinement_steps(self) -> int:
        """Optimisation steps that `finish` makes, those of a run that was cut off among them."""
        if not self.mapper.keyframes or not self.growing:
            return 0
        asked, before = self.config.refine_iterations, self.mapper.times.iterations - self.refine_iterations
        return asked if asked >= 0 else self.mapper.last_iterations(before)

    @opencv_errors("after the last frame")
    def finish(self, progress: Callable[[int, int], None] | None = None) -> SlamResult:
        """Final refinement (`refinement_steps`), then the result. `progress(done, total)` is called now and then."""
        self.settle_parts()
        start, before = time.perf_counter() - self.times.refinement, self.mapper.times.iterations
        begin, steps = self.refine_iterations, self.refinement_steps  # `begin`: by a run that was cut off

        def note(done: int, total: int) -> None:
            self.refine_iterations = begin + self.mapper.times.iterations - before
            self.times.refinement = time.perf_counter() - start
            if progress is not None:
                progress(done, total)

        try:
            if steps:
                if not begin:
                    self.mapper.use_typical_exposure(at_end=True)
                    self.color_poses.align_keyframes()
                    self.mapper.drop_hidden()
                self.mapper.refine(steps, note, begin)
            self.color_poses.align_last(lambda: note(steps, steps))
        finally:  # an interrupted refinement counts for what it did
            self.refine_iterations = begin + self.mapper.times.iterations - before
            self.times.refinement = time.perf_counter() - start
        return self.result()

    def result(self) -> SlamResult:
        """What there is so far. The first call settles the objects: it is for the end."""
        self.times.loops = self.loops.seconds if self.loops is not None else 0.0
        self.mapper.end_refinement()
        self.settle_parts()
        objects = self._objects.settle(self.mapper, self.pager) if self.growing else self._objects.learned
        cells = None if self.pager is None else self.pager.settle()
        gaussians = self._parts.gaussians()
        return SlamResult(
            gaussians, self._parts.keyframes(), self._parts.frames(), self.times, self.mapper.times,
            self.dropped_frames, self.refine_iterations, objects, self._parts.events(),
            self._places(gaussians, cells), cells, None if self.pager is None else self.pager.report(),
            [*self._notes, *still_notes(self.tracker.state.still.frames, len(self.frames)),
             *self._fixtures.notes(), *self.movers.notes(len(self.frames)),
             *self.earlier_views.notes(),
             *([] if self.pager is None else self.pager.budget.notes)],
            None if self.pager is None else self.pager.close, self.steps.to_csv(), device_name(self.map.device),
            self.config, self.movers.pixels, self._parts.movers(self.movers.tracks.describe()),
        )  # fmt: skip

    def _places(self, gaussians: GaussianMap, cells: GaussianCells | None) -> bytes | None:
        """Content of `places.npz`; None if the run looked for no loops and so remembers no places."""
        if self.loops is None or not len(self.surface):
            return None
        parts = [gaussians] if cells is None else (part for _, part in cells.parts())
        kept = self._parts.kept_numbers()
        keyframes = [self.mapper.keyframes[k] for k in kept]
        poses = np.stack([k.T_world_camera for k in keyframes])
        noise = self.tracker.noise or DepthNoise()
        cameras = [k.camera for k in keyframes] if len(self.cameras) > 1 else None
        return saved_places_to_bytes(
            self.camera, self.surface, self.loops, noise, self.scale, poses, parts, cameras, kept
        )  # fmt: skip

    def settle_parts(self) -> None:
        """Makes one part of those that the recording fell into, see `MapParts`; when there are no more frames."""
        self._parts.settle()

    def close(self) -> None:
        """Removes what is on disk of map and keyframes, for a run that has no result."""
        if self.pager is not None:
            self.pager.close()

    # --- its parts, also used by the real-time loop ------------------------------------------------------------------

    def receive(self, frame: Frame) -> Frame:
        """The frame as the run uses it: without depth that hangs between two surfaces, with depth as of the time of
        colour, and without what is fixed to the camera.

        Raises:
            SequenceError: the frame is of another camera, or not what `Frame` says.
        """
        check_frame(frame, self.camera)
        return self._fixtures.clean(self._shutters.bring(self._depth_edges.clean(frame)))

    def track(self, frame: Frame) -> TrackingResult:
        """Locates one frame, as `receive` gave it, against the current target; a lost one is looked up among all
        keyframes."""
        self.mapper.note_valid(frame)
        start = time.perf_counter()
        self._follow_moves()
        if not len(self.surface):
            self.use_scale(scene_scale(frame.depth))
        expected = self.movers.expect(frame)
        result = self.tracker.track(expected)
        if result.status is TrackingStatus.LOST and self.loops is not None and self.tracker.target is not None:
            found = self.loops.find(frame, result)
            if found is None and self.left_parts.parts:
                found = self.left_parts.find(expected, self.poses.anchor[0], self.tracker, self.loops)
            if found is not None:
                result, keyframe = found
                self.poses.anchor_to(keyframe, self.loops.poses[keyframe])
            else:
                result = self._try_new_part(frame, result)
        if result.status is not TrackingStatus.LOST:
            self.part_start.forget()
            self.left_parts.settle()
        result = self.color_poses.align(frame, result)
        located = None if result.status is TrackingStatus.LOST else result.T_world_camera
        self._shutters.follow(located)
        self._fixtures.follow(self.camera, located)
        self._tell_noise(result.median_depth_m)
        result = self.movers.look(frame, result, self.tracker.noise)
        if self.movers.may_move:
            self.tracker.be_wary()
        self.times.tracking_by_frame.append(time.perf_counter() - start)
        self.times.tracking += self.times.tracking_by_frame[-1]
        return result

    def _try_new_part(self, frame: Frame, lost: TrackingResult) -> TrackingResult:
        """What tracking says of a lost frame that no place tells of: the same, or that a new part begins with it."""
        loops, start = self.loops, self.part_start
        wanted = self.tracker.settings.recovery.new_part_after > 0 and self.pager is None
        if loops is None or not self.growing or not wanted:
            return lost
        start.watch(frame, lost, self.tracker, self.tracker.context)
        if self.config.evaluation.is_held_out(frame.index) or not self.takes_keyframes:
            return lost
        if start.is_due(frame, self.tracker):
            return self._begin_part(frame, lost, loops)
        start.keep(frame, self.masks.active, self.config.keyframes.max_gap)
        return lost

    def _begin_part(self, frame: Frame, lost: TrackingResult, loops: LoopCloser) -> TrackingResult:
        """A part of the map begins with the frames that were lost; what tracking says of the last of them."""
        start, tracker = self.part_start, self.tracker
        self.left_parts.leave(*self.poses.anchor, tracker)
        T_world_first = pose_apart(lost.T_world_camera, self.surface.poses, tracker.settings.points.max_depth)
        keyframe, first = self.poses.keyframes_made, start.first
        begun = start.begin(keyframe, lost, self.surface, T_world_first, tracker.context)
        loops.begin_part(begun.keyframes[0][0] if begun.keyframes else frame, first)
        self.poses.locate_last(keyframe, begun.T_first_camera)
        self.policy.begin_again()
        for early, tracking in begun.keyframes:
            self.policy.decide(early.index, tracking)
            self.poses.add_keyframe(tracking.T_world_camera)
        self._early = begun.keyframes
        T = begun.T_world_camera
        return tracker.begin_part(FeatureView(frame.color, frame.depth, T), lost.points, T)

    def take_early(self) -> list[tuple[Frame, TrackingResult]]:
        """Keyframes to insert before the frame that was tracked last: of those that a part begins with. `poses` knows
        them."""
        early, self._early = self._early, []
        return early

    def without_movers(self, frame: Frame) -> Frame:
        """The frame that was tracked last as the map gets it: without depth where something moves."""
        return self.movers.clean(frame)

    def _tell_noise(self, median_depth: float) -> None:
        """The mapper learns what the tracker says of the noise, on the first frame and whenever it says more."""
        noise = self.tracker.noise
        if noise is None or noise == self._noise:
            return
        if self._noise is not None or not self.mapper.keyframes:  # a map made before keeps what it was trained with
            self.mapper.depth_sigma = noise.sigma(median_depth)
        if median_depth > 0:
            self.mapper.pixel_m = median_depth / self.camera.fx
            self.mapper.depth_noise_px = noise.in_pixels(median_depth, self.camera.fx)
        self._noise = noise

    def use_scale(self, scale: float) -> None:
        """Fits tracker and mapper to a scene of this size; before the first keyframe."""
        self.scale, self.tracker.settings = scale, scale_settings(self.config.tracking, scale)
        self.mapper.settings = scale_mapping(self.config.mapping, scale)
        self.surface.settings = self.tracker.settings.target

    def use_scale_again(self) -> None:
        """Settings of the parts, which are not saved, follow the scene of a restored state."""
        self.use_scale(self.scale)

    def _follow_moves(self) -> None:
        """The tracker goes along with corrections of the map made since the last frame."""
        waits = len(self.surface) <= self.part_start.keyframe
        target, moves = self._corrections.news(self._moves_followed)
        self._moves_followed += len(moves)
        for T_new_old in moves:
            self.tracker.move(T_new_old)
            self._shutters.move(T_new_old)
            self.movers.move(T_new_old)
            self.policy.move(T_new_old)
            self.poses.move(T_new_old)
        if not waits:
            self.part_start.target = None
        elif self.part_start.target is not None:
            target = self.part_start.target
        if target is not None:
            self.tracker.set_target(target)

    @property
    def moves_followed(self) -> int:
        """How many corrections of the map the newest tracked pose knows of."""
        return self._moves_followed

    @property
    def corrections(self) -> int:
        """How many times a closed loop has moved the map."""
        return len(self._corrections)

    def pose_of(self, frame: TrackedFrame) -> np.ndarray:
        """T_world_camera [4, 4] of a frame that was not lost, as far as is known by now."""
        return self.poses.pose_of(frame, self.mapper.keyframes)

    def wants_keyframe(self, frame: Frame, tracking: TrackingResult) -> bool:
        """Whether the frame becomes a keyframe: never when lost, and never when held out for scoring (but something
        has to be the first)."""
        held_out = self.policy.kind is not None and self.config.evaluation.is_held_out(frame.index)
        if held_out or tracking.status is TrackingStatus.LOST or not self.growing:
            return False
        return self.policy.decide(frame.index, tracking)

    def _insert_beside_training(self, frame: Frame, tracking: TrackingResult) -> None:
        """`insert` and the step's training: the keyframe's place is described, and its points join the surface, while
        the host hands work to the GPU."""
        if self.loops is not None:
            self.loops.begin(frame)
        tracking = self._corrections.follow(tracking, self.moves_followed)
        self._take_out_outdated(frame, tracking)
        self.mapper.add_keyframe(frame, tracking.T_world_camera, partial(self.masks.labels, frame))
        tracking.points.read()  # what waits for the GPU is done in this thread
        with ThreadPoolExecutor(1, thread_name_prefix="surface") as beside:
            added = beside.submit(self._corrections.add_points, tracking)
            self._train_step(is_keyframe=True)
            added.result()
        self._clear_map(frame)
        self._look_for_loops(frame, tracking)

    def _train_step(self, is_keyframe: bool) -> None:
        """The step's iterations, more of them right after the first keyframe."""
        if self.mapper.keyframes and self.growing:
            settings, first = self.config.mapping, is_keyframe and len(self.mapper.keyframes) == 1
            self.mapper.run(settings.first_frame_iterations if first else settings.iterations_per_frame)

    def insert(self, frame: Frame, tracking: TrackingResult, moves_followed: int) -> None:
        """A keyframe goes into the map and into what the tracker aligns to; if it closes a loop, the map is corrected.

        Args:
            frame: of the keyframe.
            tracking: where it is.
            moves_followed: the corrections that this knows of.
        """
        tracking = self._corrections.follow(tracking, moves_followed)
        self._take_out_outdated(frame, tracking)
        if self.loops is not None:
            self.loops.begin(frame)  # this and the surface are made beside what follows, which one thread alone does
        self._corrections.begin_points(tracking)
        if self.pager is not None:
            self.pager.prepare(tracking.T_world_camera, frame.depth)
        before = self.map.count
        keyframe = self.mapper.add_keyframe(frame, tracking.T_world_camera, partial(self.masks.labels, frame))
        added = self.map.count - before
        self._corrections.add_points(tracking)
        self._clear_map(frame)
        self._look_for_loops(frame, tracking)
        if self.pager is not None:
            self.pager.finish_insertion(keyframe, added, 0 if self.loops is None else self.loops.places.held_bytes)

    def _take_out_outdated(self, newest: Frame, tracking: TrackingResult) -> None:
        """Takes out of the map that the run began with what the frame, about to become a keyframe, helps to tell."""
        self._corrections.take_out_outdated(self.earlier_views, newest, tracking, self._noise, self.context)

    def _clear_map(self, newest: Frame) -> None:
        """Takes out what does not belong there, as far as the newest keyframe tells."""
        self._corrections.leave_out(self._fixtures, newest)
        self._corrections.take_out(self.movers, newest)

    def _look_for_loops(self, frame: Frame, tracking: TrackingResult) -> None:
        if self.loops is not None:
            correction = self.loops.add(frame, tracking)
            if correction is not None:
                self._corrections.apply(correction, self.loops)
                self.earlier_views.forget()
