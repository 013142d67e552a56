# SPDX-License-Identifier: Apache-2.0
"""The loop: frames in, trajectory and map out.

    sequence = open_sequence("recording", scale=0.5)
    slam = Slam(sequence.camera)
    for frame in sequence.stream():
        slam.step(frame)
    result = slam.finish()

`Slam._step` and `Slam.map_keyframe` are the algorithm, in seven steps. Every way of running uses them: a rig of cameras
has another `locator`, a GPU and real time another `schedule`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from ggslam.geometry.scene_size import scene_scale
from ggslam.mapping.scale import scale_settings as scale_mapping
from ggslam.scene.frame import Frame
from ggslam.scene.frame_checks import check_frame
from ggslam.slam.filters.depth_edges import DepthEdges
from ggslam.slam.frame_locator import Located
from ggslam.slam.joining import JoiningTuning
from ggslam.slam.loop_results import Correction
from ggslam.slam.result import SlamResult, StepReport
from ggslam.slam.run_end import refine, result_of
from ggslam.slam.run_state import RunState
from ggslam.slam.schedules import NewKeyframe
from ggslam.system.opencv import opencv_errors, raise_as_ours
from ggslam.system.process_memory import trim
from ggslam.system.savable import savable
from ggslam.system.spent import count_beside, part
from ggslam.system.tuning import Tuning
from ggslam.tracking.scale import scale_settings
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult, TrackingStatus

LOST = TrackingStatus.LOST.value


class TrimTuning(Tuning):
    """How freed memory is returned to the system."""

    keyframes = 8
    """Keyframes between two calls that return freed memory. A call takes milliseconds."""


@savable(not_saved="camera config context pager start_notes end_notes schedule joining", after="use_scale_again")
class Slam(RunState):
    """Synchronous SLAM: each step tracks one frame, maybe makes a keyframe of it, and trains the map a fixed number
    of iterations. Deterministic for a given configuration and machine.

    Args:
        camera: of all frames.
        config: all settings.
        has_masks: whether the recording has object masks; None: judged by the first keyframe's frame.
        paging: folder that what does not fit into `memory_limit_mb` moves to; None: a temporary one.
        library: CUDA kernels to compute with; None: as `config.device` says.
        extra_loss: a loss of one's own in every mapping iteration, extra_loss(view, keyframe) -> scalar tensor, see
            `mapping.extra_loss.ExtraLoss`.

    Raises:
        InputError: an argument is not a camera, a configuration or a function.
        ConfigError: a limit of memory that is less than the program itself takes; no such device.
    """

    # --- the loop ----------------------------------------------------------------------------------------------------

    def step(self, frame: Frame) -> StepReport:
        """Track one frame, maybe make a keyframe of it, train.

        Raises:
            SequenceError: the frame is of another camera, or not what `Frame` says.
            OpenCvError: OpenCV refused its images.
        """
        return self.step_together([frame])[0]

    def step_together(self, frames: Sequence[Frame]) -> list[StepReport]:
        """The same for the frames of one instant, of different cameras of a rig.

        Args:
            frames: `Frame.camera_number` and `Frame.instant` say of which camera and when.

        Returns:
            What the step did, for each frame; what it took besides its length is the first one's.
        """
        try:
            return self._step(frames)
        except cv2.error as error:
            raise_as_ours(error, f"frame {frames[0].index}")

    def _step(self, frames: Sequence[Frame]) -> list[StepReport]:
        start = time.perf_counter()
        self.times.start()
        self.schedule.begin_step()
        self.joining.begin_step()

        # 1. Clean the frames: no depth that hangs between two surfaces, was taken at another time than the colour, or
        #    shows what is fixed to the camera.
        with part("tracking"):
            cleaned = list(map(self.clean, frames))

            # 2. Track: follow what closed loops have corrected, then align the frames' points to the map (G-ICP). A
            #    lost camera is looked for at all known places, or begins a new part of the map.
            with self.schedule.beside_mapping():
                located = self.track(cleaned)

        # 3. Decide whether the frames become keyframes: those that show enough that the map does not, and one every
        #    few frames.
        chosen = self._choose_keyframes(located)
        self._note_poses(located, chosen)

        # 4. to 7. Map the keyframes and train: `map_keyframe` and `train`, at once or in another thread.
        new = [*located.early]
        if chosen:
            new += [(located.frames[k], located.tracked[k]) for k in chosen]
        with part("mapping"):
            keyframes = [NewKeyframe(*one, self.moves_followed) for one in new] if new else []
            self.schedule.map(self, keyframes, len(frames))

        self.times.stop()
        seconds = (time.perf_counter() - start) / len(frames)
        return [self._report(k in chosen, seconds, k - len(frames)) for k in range(len(frames))]

    def map_keyframe(self, new: NewKeyframe, train: Callable[[], None] | None = None) -> None:
        """A keyframe goes into the map and into what the tracker aligns to; if it closes a loop, the map is corrected.

        Args:
            new: the keyframe.
            train: the step's training, if the next frames do not wait for the keyframe to join what they are aligned
                to; else that is the caller's.
        """
        frame, tracking = new.frame, self.corrections.follow(new.tracking, new.moves_followed)
        chain = self.chains[frame.camera_number]

        def begin_others() -> None:
            if self.loops is not None:
                self.loops.begin(frame)
            if train is None:
                self.corrections.begin_points(tracking)

        # 4. Insert Gaussians where the map lacks what the keyframe shows, after removing what it looks through. Its
        #    place and its points are prepared meanwhile, in other threads.
        tracking.points.send()
        chain.before_insertion(self.removal, frame, tracking)
        self.mapper.has_soft_outlines = bool(chain.get(DepthEdges).soft)
        if self.pager is not None:
            self.pager.prepare(tracking.T_world_camera, frame.depth)
        before = self.map.count
        labeller = partial(self.masks.labels, frame)
        keyframe = self.mapper.add_keyframe(frame, tracking.T_world_camera, labeller, begin_others)
        added = self.map.count - before

        # 5. and 6. The same beside the next frames.
        if train is not None:
            self._join_beside(frame, tracking, train)
            return

        # 5. Add its points to the measured surface that the next frames are aligned to.
        self.corrections.add_points(tracking)

        # 6. Remove what is fixed to the camera or has moved since; then close a loop, if the keyframe shows a known
        #    place: the graph of keyframe poses is optimised, and the map moves with its keyframes.
        chain.after_insertion(self.removal, frame)
        self._close_loop(self._look_for_loop(frame, tracking))
        if self.pager is not None:
            self.pager.finish_insertion(keyframe, added, 0 if self.loops is None else self.loops.places.held_bytes)

    def _look_for_loop(
        self, frame: Frame, tracking: TrackingResult, noise: DepthNoise | None = None
    ) -> Correction | None:
        """What has to move if the newest keyframe shows a known place; `noise` as of `LoopCloser.add`."""
        if self.loops is None:
            return None
        with part("loops"):
            return self.loops.add(frame, tracking, noise)

    def _close_loop(self, correction: Correction | None) -> None:
        if correction is not None and self.loops is not None:
            self.corrections.apply(correction, self.loops)
            self.filters.loop_closed()

    def _join_beside(self, frame: Frame, tracking: TrackingResult, train: Callable[[], None]) -> None:
        """Steps 5 and 6 beside the training and the next frame, which is aligned to what there was before. Where that
        shows too little, or a part of the map begins, they are waited for."""
        tracking.points.read()  # what waits for the GPU is done in this thread
        noise = self.tracker.noise  # frames change it

        @opencv_errors(f"frame {frame.index}")
        def join() -> Correction | None:
            start = time.perf_counter()
            self.corrections.add_points(tracking)
            correction = self._look_for_loop(frame, tracking, noise)
            self.times.beside += time.perf_counter() - start  # no other thread writes it
            return correction

        def finish(correction: Correction | None) -> None:
            self.corrections.show_target()
            with self.mapper.in_turn():  # a lost frame may ask for it, beside the mapper's work
                self.chains[frame.camera_number].after_insertion(self.removal, frame)
                self._close_loop(correction)

        shown = 0.0 if self.tracker.target is None else tracking.overlap
        waits = shown < JoiningTuning.min_overlap or self.locator.part_start.target is not None
        self.corrections.hold_target()
        self.joining.start(count_beside(join, "mapping"), finish, self.give_up_joining)
        train()
        if waits:
            self.end_joining()

    def train(self, frames: int, keyframes_before: int) -> None:
        """The training of a step.

        Args:
            frames: of the step.
            keyframes_before: how many keyframes there were before it.
        """
        # 7. Train the map on keyframes drawn at random: longer on the very first ones.
        count, settings = len(self.mapper.keyframes), self.config.mapping
        if count // TrimTuning.keyframes != keyframes_before // TrimTuning.keyframes:
            trim()
        if count and self.growing:
            first = settings.first_frame_iterations * count
            self.mapper.run(settings.iterations_per_frame * frames if keyframes_before else first)

    # --- the tracker's steps -----------------------------------------------------------------------------------------

    def clean(self, frame: Frame) -> Frame:
        """The frame as the run uses it.

        Raises:
            SequenceError: the frame is of another camera, or not what `Frame` says.
        """
        check_frame(frame, self.cameras[frame.camera_number])
        return self.chains[frame.camera_number].clean(frame)

    def track(self, frames: list[Frame]) -> Located:
        """Locates the frames of an instant, as `clean` gave them, and corrects them by what their poses tell."""
        start = time.perf_counter()
        self.follow_corrections()
        for frame in frames:
            self.mapper.note_valid(frame)
        if not len(self.surface):
            self.use_scale(scene_scale(np.concatenate([frame.depth.reshape(-1) for frame in frames])))
        located = self.locator.locate(frames, self.growing, self.schedule.takes_keyframes)
        self._set_noise(located.joint)
        seen, tracked = list[Frame](), list[TrackingResult]()
        for frame, tracking in zip(located.frames, located.tracked, strict=True):
            judged = self.chains[frame.camera_number].judge(frame, tracking, self.tracker.state.noise)
            seen.append(judged[0])
            tracked.append(judged[1])
        if self.filters.expects_motion():
            self.tracker.expect_motion()
        seconds = time.perf_counter() - start
        self.times.tracking_by_frame += [seconds / len(frames)] * len(frames)
        self.times.tracking += seconds
        return Located(seen, located.joint, tracked, located.early)

    def use_scale(self, scale: float) -> None:
        """Fits tracker and mapper to a scene of this size; before the first keyframe."""
        self.scale, self.tracker.settings = scale, scale_settings(self.config.tracking, scale)
        self.mapper.settings = scale_mapping(self.config.mapping, scale)
        self.surface.settings = self.tracker.settings.target

    def use_scale_again(self) -> None:
        """Fits the parts to the scene once more, where settings that follow it were not restored with a saved state."""
        self.use_scale(self.scale)

    def _set_noise(self, tracked: TrackingResult) -> None:
        """The mapper learns what the tracker says of the noise, on the first frame and whenever it says more."""
        noise = self.tracker.state.noise
        if noise is None or noise is self._noise or noise == self._noise:
            return
        median_depth = tracked.median_depth_m
        if self._noise is not None or not self.mapper.keyframes:  # a map made before keeps what it was trained with
            self.mapper.depth_sigma = noise.sigma(median_depth)
        if median_depth > 0:
            self.mapper.pixel_m = median_depth / self.camera.fx
            self.mapper.depth_noise_px = noise.in_pixels(median_depth, self.camera.fx)
        self._noise = noise

    def _choose_keyframes(self, located: Located) -> list[int]:
        """Which of the frames become keyframes: none of an instant that is lost or held out for scoring (but something
        has to be the first), else all that can, or none."""
        first = located.frames[0]
        number = first.index if first.instant is None else first.instant
        held_out = self.policy.kind is not None and self.config.evaluation.is_held_out(number)
        if held_out or located.is_lost or not self.growing or not self.schedule.takes_keyframes:
            return []
        candidates = self.locator.keyframe_candidates(located)
        if not candidates:
            return []
        joint, least = located.joint, located.tracked[candidates[0]].overlap
        for k in candidates[1:]:
            least = min(least, located.tracked[k].overlap)
        if least != joint.overlap:
            joint = replace(joint, overlap=least)
        return candidates if self.policy.decide(number, joint) else []

    def _note_poses(self, located: Located, chosen: list[int]) -> None:
        """Poses are remembered relative to the newest keyframe, so that they move with it."""
        for k in chosen:
            self.poses.add_keyframe(located.tracked[k].T_world_camera)
        for k, (frame, tracking) in enumerate(zip(located.frames, located.tracked, strict=True)):
            self.poses.add(frame, tracking)
            if k not in chosen:
                self.locator.note(frame, tracking)
                self._keep_between(frame, tracking)

    def _keep_between(self, frame: Frame, tracking: TrackingResult) -> None:
        """Keeps the frame that `poses` took last for the final refinement, if it shows the map and nothing else."""
        if not (self.growing and self.mapper.keeps_between):
            return
        located = tracking.status in (TrackingStatus.OK, TrackingStatus.RECOVERED) and not tracking.still
        alone = frame.instant is None and (frame.moving is None or not frame.moving.any())
        if located and alone and not self.config.evaluation.is_held_out(frame.index):
            pose = self.poses.frames[-1]
            self.mapper.keep_between(frame, pose.keyframe, pose.T_keyframe_camera)

    def _report(self, is_keyframe: bool, seconds: float, number: int) -> StepReport:
        """What the step did that has just ended with frame `number` of `frames` and took `seconds`; `steps` remembers
        it."""
        loops_s = 0.0 if self.loops is None else self.loops.seconds
        frame = self.poses.frames[number]
        pose = None if frame.status == LOST else self.poses.as_tracked(frame)
        return self.steps.add(
            frame, pose, is_keyframe, seconds, self.times, loops_s, self.mapper, self.gaussian_count
        )

    # --- the end of a run --------------------------------------------------------------------------------------------

    @opencv_errors("after the last frame")
    def finish(self, progress: Callable[[int, int], None] | None = None) -> SlamResult:
        """Final refinement (`refinement_steps`), then the result. `progress(done, total)` is called now and then."""
        refine(self, progress)
        return self.result()

    def result(self) -> SlamResult:
        """What there is so far, also after an error. The first call settles the objects: it is for the end."""
        self.settle()
        return result_of(self)
