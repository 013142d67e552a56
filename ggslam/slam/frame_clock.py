# SPDX-License-Identifier: Apache-2.0
"""Paces the frames of a recording like a camera, and drops frames, also of a live camera, that come too late."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator

from ggslam.scene.frame import Frame
from ggslam.system.tuning import Tuning


class ClockTuning(Tuning):
    """When a frame counts as late."""

    max_lag_frames = 3
    """Delay, in frame intervals, from which a frame is dropped: a live camera would have overwritten it."""
    waited_s = 1e-3
    """Waiting time, in seconds, above which a frame was not available yet when it was requested."""


class FrameClock:
    """Yields each frame when it is due and drops frames that are late because the caller was busy.

    A recording's frame is due by its index, a live camera's by its timestamp, and never waited for. Only the caller's
    own delay makes frames late: where the source lets the caller wait (a camera that stalls, one slower than stated,
    a slow disk), the clock starts anew with what comes then.

    Args:
        period: seconds from frame to frame, as stated.
        live: whether the source keeps its own pace.
        now: tells the time, seconds.
        sleep: lets seconds pass.
    """

    def __init__(
        self, period: float, live: bool = False, now: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:  # fmt: skip
        self.period, self.live = period, live
        self._now, self._sleep = now, sleep
        self._begin = 0.0
        """When the frame of index or timestamp 0 is due."""
        self._catching_up = False

    def pace(self, frames: Iterable[Frame], drop: Callable[[Frame], None]) -> Iterator[Frame]:
        """The frames in time; `drop` gets each that is too late. The first one is always in time, and the clock starts
        when the caller is done with it."""
        iterator, asked, first = iter(frames), self._now(), True
        for frame in iterator:
            waited = self._now() - asked
            if first:
                yield frame
                self._begin, first = self._now() - self._offset(frame), False
            elif self._is_late(frame, waited):
                drop(frame)
            else:
                yield frame
            asked = self._now()

    def due(self, frame: Frame) -> float:
        """When a frame of a recording was due, by `now`; NaN of the first one, which starts the clock."""
        return self._begin + self._offset(frame) if self._begin else float("nan")

    def _offset(self, frame: Frame) -> float:
        return frame.timestamp if self.live else frame.index * self.period

    def _is_late(self, frame: Frame, waited: float) -> bool:
        """Whether the frame is to be dropped; sleeps until it is due."""
        late = self._now() - (self._begin + self._offset(frame))
        if late > ClockTuning.max_lag_frames * self.period:
            # Behind its buffer a recording has to be read, which takes a part of a period: that is catching up still.
            self._catching_up = waited <= (
                self.period / 2 if self._catching_up and not self.live else ClockTuning.waited_s
            )
            if self._catching_up:
                return True
            self._begin += late
        elif late < 0 and self.live:
            self._begin += late  # the shortest delay is the camera's own
        elif late < 0:
            self._sleep(-late)
        self._catching_up = False
        return False
