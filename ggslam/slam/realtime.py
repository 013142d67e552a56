# SPDX-License-Identifier: Apache-2.0
"""Real-time operation: frames arrive at a camera's pace, tracker and mapper work side by side.

The tracker runs in the caller's thread and never waits for the mapper: it aligns to the newest target there is. The
mapper runs in a thread of its own: it inserts keyframes as they come, publishes a new target after each, and otherwise
optimises the map for as long as the recording lasts. On a GPU the mapper goes on with the stream that its tensors were
made on; the tracker, which shares none of them, gets another, whose work goes first.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager

from ggslam.scene.frame import Frame
from ggslam.slam.frame_clock import FrameClock
from ggslam.slam.result import StepReport
from ggslam.slam.schedules import MapSteps, NewKeyframe, Schedule
from ggslam.slam.slam import Slam
from ggslam.system.opencv import opencv_errors
from ggslam.system.tuning import Tuning


class RealtimeTuning(Tuning):
    """How the tracker and the mapper share the work in real time."""

    max_waiting = 8
    """Keyframes waiting for the mapper from which no more are made, so that memory stays bounded."""


class _InAnotherThread(Schedule):
    """Keyframes wait for the mapper's thread, which trains by itself.

    Args:
        jobs: that it takes them from.
        beside: context for work beside the mapper's.
    """

    def __init__(self, jobs: queue.Queue[NewKeyframe | None], beside: AbstractContextManager[object]) -> None:
        self._jobs, self._beside = jobs, beside

    def begin_step(self) -> None:
        self.takes_keyframes = (
            self._jobs.qsize() < RealtimeTuning.max_waiting
        )  # and no fewer will wait until this one is put in

    def beside_mapping(self) -> AbstractContextManager[object]:
        return self._beside

    def map(self, slam: MapSteps, keyframes: Sequence[NewKeyframe], frames: int) -> None:
        for keyframe in keyframes:
            self._jobs.put(keyframe)


class RealtimeSlam:
    """Paces a `Slam`.

    Args:
        slam: a fresh `Slam`; its parts are used from two threads.
        frames_per_second: rate at which frames arrive.
        live: whether they come at a camera's own pace; else they are delivered at that rate.

    Attributes:
        clock: when frames are due.
        mapped: is told of every keyframe that is in the map, in the mapper's thread.
    """

    def __init__(self, slam: Slam, frames_per_second: float, live: bool = False) -> None:
        self.slam, self.live = slam, live
        self.period = 1.0 / frames_per_second
        self.clock = FrameClock(self.period, live)
        self.mapped: Callable[[Frame], None] = lambda frame: None
        self._jobs: queue.Queue[NewKeyframe | None] = queue.Queue()
        self._mapper_error: BaseException | None = None
        slam.schedule = _InAnotherThread(self._jobs, slam.mapper.beside_others())
        slam.mapper.is_live = slam.color_poses.live = True  # the map changes meanwhile
        slam.use_context_beside_mapping()

    def run(self, frames: Iterable[Frame], report: Callable[[Frame, StepReport], None]) -> None:
        """Processes all frames; `report` is called for each. Errors of either thread are raised here."""
        worker = threading.Thread(target=self._map, name="mapper", daemon=True)
        worker.start()
        try:
            self._track(frames, report)
        finally:
            self._jobs.put(None)
            worker.join()
        if self._mapper_error is not None:
            raise self._mapper_error

    # --- tracker's thread --------------------------------------------------------------------------------------------

    def _track(self, frames: Iterable[Frame], report: Callable[[Frame, StepReport], None]) -> None:
        slam = self.slam
        for frame in self.clock.pace(frames, lambda late: slam.dropped_frames.append(late.index)):
            with opencv_errors(f"frame {frame.index}"):
                if not slam.frames:
                    self._first(frame, report)
                else:
                    report(frame, slam.step(frame))
            if self._mapper_error is not None:
                return

    def _first(self, frame: Frame, report: Callable[[Frame, StepReport], None]) -> None:
        """Nothing can be tracked before there is a map: the clock starts when the first keyframe is in."""
        report(frame, self.slam.step(frame))
        while self.slam.tracker.target is None and self._mapper_error is None and self._jobs.unfinished_tasks:
            time.sleep(1e-3)

    # --- mapper's thread ---------------------------------------------------------------------------------------------

    def _map(self) -> None:
        try:
            while self._insert_next():
                if self.slam.mapper.keyframes and self.slam.growing:
                    self.slam.mapper.run(1)
        except BaseException as error:  # handed to the caller's thread
            self._mapper_error = error

    def _insert_next(self) -> bool:
        """Inserts a waiting keyframe, if any; False when the recording is over and none is left."""
        slam = self.slam
        try:
            job = self._jobs.get(block=not slam.mapper.keyframes)
        except queue.Empty:
            return True
        if job is None:
            return False
        with opencv_errors(f"frame {job.frame.index}"):
            slam.map_keyframe(job)
        self.mapped(job.frame)
        self._jobs.task_done()
        return True
