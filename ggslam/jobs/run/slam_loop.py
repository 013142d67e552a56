# SPDX-License-Identifier: Apache-2.0
"""The loop over a recording: feeds frames to `Slam` and saves checkpoints until the end or an interruption."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from ggslam.cuda.availability import kernels_to_compile
from ggslam.errors import DeviceError
from ggslam.jobs.progress import Observer
from ggslam.jobs.run.checkpointing import Checkpointing
from ggslam.jobs.run.named_loss import NamedLoss
from ggslam.mapping.extra_loss import ExtraLoss
from ggslam.runs.folder import RunFolder
from ggslam.runs.starting import start_in_map
from ggslam.scene.frame import Frame
from ggslam.sequences import Sequence
from ggslam.sequences.live import LiveSequence
from ggslam.sequences.rig import RigSequence, by_instant
from ggslam.slam.config import Config
from ggslam.slam.latency import LatencyMeter
from ggslam.slam.realtime import RealtimeSlam
from ggslam.slam.result import SlamResult, StepReport, tracked_poses
from ggslam.slam.rig_slam import RigSlam
from ggslam.slam.slam import Slam
from ggslam.system.interrupts import StopRequest
from ggslam.system.plurals import quantity
from ggslam.system.spent import part
from ggslam.system.staging import new_staging

Follower = Callable[[Slam, Frame, StepReport], None]
"""Is called after every frame, in the thread that tracks."""
Waiting = Callable[[Slam], None]
"""Is called again and again while a camera's next frame is waited for, in the same thread."""


@dataclass
class SlamLoop:
    """Everything that the loop over a recording uses.

    Attributes:
        sequence: the recording.
        config: all settings.
        observer: receives progress updates.
        folder: of the run.
        earlier: run whose map this one begins with.
        growing: whether that map grows.
        follower: does more with each frame.
        waiting: does something while no frame comes.
        checkpointing: saves the state; None: never.
        stop: says when to end early.
        resume: brings a fresh `Slam` to where it was, and tells which frame comes next, None if it was nowhere yet.
        told: notes of the run that were told at its start.
        loss: a loss of the user's own that joins the mapper's.
        saw_all: whether all frames were tracked, and what is left is the refinement.
        latency: of a camera, and in real time: how long poses and map take.
    """

    sequence: Sequence | LiveSequence
    config: Config
    observer: Observer
    folder: RunFolder | None = None
    earlier: RunFolder | None = None
    growing: bool = True
    follower: Follower | None = None
    waiting: Waiting | None = None
    checkpointing: Checkpointing | None = None
    stop: StopRequest = field(default_factory=StopRequest)
    resume: Callable[[Slam], int | None] | None = None
    told: list[str] = field(default_factory=list)
    loss: NamedLoss | None = None
    saw_all: bool = False
    latency: LatencyMeter | None = None
    _between_steps: bool = False

    def run(self) -> tuple[SlamResult, BaseException | None]:
        """All frames, the refinement, the result; and what ended the run early, if something did: what there was until
        then is the result.

        Raises:
            GgslamError: settings or map do not fit the recording; or the disk is full of what does not fit into
                memory: then the trajectory is in `folder`, and the map is lost.
        """
        if self.config.device != "cpu" and kernels_to_compile():
            self.observer.note("compiling the CUDA kernels, once: about a minute")
        folder = self.folder
        paging = new_staging(folder.path) if self.config.memory_limit_mb and folder is not None else None
        slam = make_slam(self.sequence, self.config, paging, self.loss)
        if self.loss is not None:
            slam.start_notes.append(f"trained with a loss of your own, {self.loss.name}")
            if isinstance(self.sequence, Sequence):
                self.loss.try_on(next(iter(self.sequence.stream(masks="lazy"))), slam.map.device)
        self.told = list(slam.start_notes)
        for note in self.told:
            self.observer.note(note)
        begin = None if self.resume is None else self.resume(slam)
        if begin is None and self.earlier is not None:
            start_in_map(slam, self.earlier, self.growing)
        try:
            self._frames(slam, begin or 0)
            return self._refine(slam), None
        except (Exception, KeyboardInterrupt) as stopped:  # whatever it is: finished work is saved, then it is raised
            error = _for_people(stopped)
        if self._between_steps and self.checkpointing is not None:
            self.checkpointing.save(slam)
        return self._what_there_is(slam), error

    def _frames(self, slam: Slam, begin: int) -> None:
        sequence, observer = self.sequence, self.observer
        observer.begin("track + map" if slam.growing else "localize", len(sequence) - begin)
        if isinstance(sequence, Sequence):
            frames = sequence.stream(masks="lazy", begin=begin)  # only those of keyframes are read
        else:
            frames = sequence.stream(masks="lazy")
            sequence.say, sequence.goes_on = observer.note, lambda: self._waits_on(slam)
            self.latency = LatencyMeter(sequence.moment_of)
        self._between_steps = self.config.realtime_fps == 0
        if self.config.realtime_fps > 0:
            self._side_by_side(slam, frames)
            return
        for together in by_instant(frames):
            self._between_steps = False
            steps = slam.step_together(together)
            for frame, step in zip(together, steps, strict=True):
                self._report(slam, frame, step, whole=frame is together[-1])

    def _waits_on(self, slam: Slam) -> bool:
        """Whether a frame that does not come yet is waited for."""
        if self.waiting is not None:
            self.waiting(slam)
        return self.stop.number is None

    def _side_by_side(self, slam: Slam, frames: Iterator[Frame]) -> None:
        """All frames in real time."""
        paced = RealtimeSlam(slam, self.config.realtime_fps, live=isinstance(self.sequence, LiveSequence))
        paced.clock.drops = not (isinstance(self.sequence, LiveSequence) and self.sequence.counts() is not None)
        if self.latency is None:
            self.latency = LatencyMeter(paced.clock.due, time.perf_counter)
        paced.mapped = self.latency.in_map
        with part("tracking and mapping, side by side", whole=True):
            paced.run(frames, lambda *step: self._report(slam, *step))

    def _report(self, slam: Slam, frame: Frame, step: StepReport, whole: bool = True) -> None:
        """After every frame; `whole`: no other one was part of the same step and is still to come."""
        if self.latency is not None:
            self.latency.pose_known(frame)
            if step.is_keyframe and self.config.realtime_fps == 0:
                self.latency.in_map(frame)
        self.observer.frame(step)
        if self.follower is not None:
            self.follower(slam, frame, step)
        if not whole:
            return
        if self.config.realtime_fps == 0:
            self._between_steps = True
            if self.checkpointing is not None:
                self.checkpointing.after(slam, frame)
        self.stop.raise_if_any()

    def _refine(self, slam: Slam) -> SlamResult:
        self.saw_all = True
        slam.join_parts()
        wanted = slam.refinement_steps
        if wanted:
            self.observer.begin("refine", wanted)

        def note(done: int, total: int) -> None:
            self._between_steps = True
            self.observer.advance(done, total)
            if self.checkpointing is not None:
                self.checkpointing.after(slam, None)
            self.stop.raise_if_any()
            self._between_steps = False

        self._between_steps = False
        return slam.finish(note)

    def _what_there_is(self, slam: Slam) -> SlamResult:
        try:
            return _result_of(slam)
        except Exception as failure:  # the disk is full, and what is there goes to make room
            slam.close()
            if self.folder is not None and slam.frames:
                stamps = np.array([frame.timestamp for frame in slam.frames])
                kept = self.folder.save_trajectory(stamps, _last_poses(slam), repr(failure))
                self.observer.note(
                    f"the map is lost; the trajectory of {quantity(len(stamps), 'frame')} is in {kept.path}"
                )
            raise


def make_slam(
    sequence: Sequence | LiveSequence, config: Config, paging: Path | None = None, loss: ExtraLoss | None = None
) -> Slam:
    """A fresh `Slam` for a recording; arguments and errors as of `Slam`."""
    if isinstance(sequence, RigSequence):
        return RigSlam(sequence.rig, config, sequence.has_masks, loss)
    return Slam(sequence.camera, config, sequence.has_masks, paging, extra_loss=loss)


def _for_people(stopped: BaseException) -> BaseException:
    """The error as it is told to people."""
    if isinstance(stopped, torch.cuda.OutOfMemoryError):
        return DeviceError(f"the GPU's memory is full: {str(stopped).partition('. GPU')[0]}")
    return stopped


def _result_of(slam: Slam) -> SlamResult:
    """Where the memory of a GPU is full there is none for the last identity steps either: then without them."""
    try:
        return slam.result()
    except torch.cuda.OutOfMemoryError:
        torch.cuda.empty_cache()
        return slam.result()


def _last_poses(slam: Slam) -> np.ndarray:
    """T_world_camera of all frames; of keyframes that a GPU which failed will not tell, as they were tracked."""
    try:
        poses = [keyframe.T_world_camera for keyframe in slam.mapper.keyframes]
    except Exception:
        poses = list(slam.surface.poses)
    return tracked_poses(slam.frames, poses)
