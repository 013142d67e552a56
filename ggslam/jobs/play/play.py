# SPDX-License-Identifier: Apache-2.0
"""Plays a recording into topics at its rate: a camera that is none."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from ggslam.errors import ConfigError, MiddlewareError
from ggslam.jobs.play.camera_topics import CameraTopics, EncodedFrame, TopicForm
from ggslam.jobs.progress import Observer
from ggslam.middleware.node import Node
from ggslam.middleware.opening import NodeRequest, open_node
from ggslam.middleware.types import message_types
from ggslam.runs.recordings import SequenceRequest
from ggslam.sequences import Sequence
from ggslam.sequences.rig import RigSequence
from ggslam.system.interrupts import StopRequest, stop_on_request
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning


class PlayTuning(Tuning):
    """How a recording is played."""

    slice_s = 0.05
    """Seconds between two looks at whether to end, or whether somebody listens."""
    late_s = 0.01
    """Seconds after its time from which a frame counts as sent late."""
    last_s = 0.5
    """Seconds that the network gets for the last messages."""
    loop_gap_s = 1 / 30
    """Seconds from the last frame to the first one of the next round."""


@dataclass(frozen=True)
class PlayRequest:
    """What to play and how.

    Attributes:
        sequence: the recording.
        node: how to join the network.
        form: of the topics.
        rate: how much faster than it was recorded.
        fps: frames a second instead.
        loop: begin again at its end.
        recorded_stamps: stamps are the recording's; else of the wall clock, when each frame is sent.
        wait_s: how long to wait until somebody listens; None: not at all.
    """

    sequence: SequenceRequest
    node: NodeRequest = field(default_factory=NodeRequest)
    form: TopicForm = field(default_factory=TopicForm)
    rate: float = 1.0
    fps: float | None = None
    loop: bool = False
    recorded_stamps: bool = False
    wait_s: float | None = 60.0


@dataclass
class Played:
    """What was sent: frames, seconds from the first to the last, bytes, frames sent late, messages that the middleware
    did not take, and whether a signal ended it."""

    frames: int = 0
    seconds: float = 0.0
    bytes: int = 0
    late: int = 0
    left_out: int = 0
    stopped: StopRequest = field(default_factory=StopRequest)

    def text(self) -> str:
        """One line for people."""
        rate = ""
        if self.frames > 1 and self.seconds > 0:
            per_s = (self.frames - 1) / self.seconds
            rate = f" in {self.seconds:.1f} s ({per_s:.1f}/s, {1e-6 * per_s * self.bytes / self.frames:.1f} MB/s)"
        return (
            f"sent {quantity(self.frames, 'frame')}{rate}; {self.late} late, "
            f"{quantity(self.left_out, 'message')} not taken by the middleware"
        )


def play(request: PlayRequest, observer: Observer, node: Node | None = None) -> Played:
    """Plays a recording to its end, or until it is stopped.

    Args:
        request: what to play.
        observer: receives progress updates.
        node: to play with; None: one that the request tells.

    Raises:
        SequenceError: the recording cannot be read.
        MiddlewareError: the network cannot be joined, or nobody listens in time.
        MissingDependency: a package is needed for it.
    """
    sequence = request.sequence.open(truth=False)
    if isinstance(sequence, RigSequence):
        raise ConfigError(f"{sequence.path}: a rig cannot be played; play the recording of one of its cameras")
    types = message_types(request.node.distribution)
    used = open_node(request.node, "ggslam_play") if node is None else node
    try:
        topics = CameraTopics(used, types, request.form)
        names = ", ".join(publisher.topic for publisher in topics.publishers)
        observer.note(f"publishing {names}, {sequence.camera.width}x{sequence.camera.height}")
        if not request.form.metres:
            observer.note("depth is rounded to whole millimetres (16UC1)")
        with stop_on_request() as stop:
            if request.wait_s is not None:
                _wait_for_listener(topics, request.wait_s, stop)
            played = _Player(request, sequence, topics, observer, stop).run()
            time.sleep(PlayTuning.last_s if played.frames else 0)
        played.left_out = sum(publisher.left_out for publisher in topics.publishers)
        return played
    finally:
        used.close()


def _wait_for_listener(topics: CameraTopics, seconds: float, stop: StopRequest) -> None:
    end = time.monotonic() + seconds
    while not topics.is_heard and stop.number is None:
        if time.monotonic() > end:
            names = f"`{topics.color.topic}` and `{topics.depth.topic}`"
            raise MiddlewareError(f"nobody listens to {names} within {seconds:g} s")
        time.sleep(PlayTuning.slice_s)


@dataclass
class _Player:
    """Sends the frames of a sequence when they are due."""

    request: PlayRequest
    sequence: Sequence
    topics: CameraTopics
    observer: Observer
    stop: StopRequest
    now: Callable[[], float] = time.perf_counter

    def run(self) -> Played:
        count, played = len(self.sequence), Played(stopped=self.stop)
        self.observer.begin("play", count)
        begin = self.now()
        for number, (due, stamp, frame) in enumerate(self._frames()):
            if not self._wait_until(begin + due):
                break
            at = self.now()
            played.late += at > begin + due + PlayTuning.late_s
            self.topics.send(frame, stamp if self.request.recorded_stamps else time.time())
            played.frames, played.bytes, played.seconds = number + 1, played.bytes + frame.size, at - begin
            self.observer.advance(number % count + 1, count)
        return played

    def _frames(self) -> Iterator[tuple[float, float, EncodedFrame]]:
        """When each frame is due, seconds after the first one, its recorded time, and its messages."""
        times = self.sequence.timestamps
        dues = np.arange(len(times)) / self.request.fps if self.request.fps else (times - times[0]) / self.request.rate
        gap = float(np.median(np.diff(dues))) if len(dues) > 1 else PlayTuning.loop_gap_s
        for round_number in itertools.count() if self.request.loop else range(1):
            for frame in self.sequence.stream(masks=False):
                due = float(dues[frame.index]) + round_number * (float(dues[-1]) + gap)
                yield due, frame.timestamp, self.topics.encode(frame)

    def _wait_until(self, at: float) -> bool:
        """Waits for a time; False: it is to end."""
        while (left := at - self.now()) > 0 and self.stop.number is None:
            time.sleep(min(left, PlayTuning.slice_s))
        return self.stop.number is None
