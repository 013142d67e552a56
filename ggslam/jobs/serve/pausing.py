# SPDX-License-Identifier: Apache-2.0
"""Holds a run between two frames, in the thread that tracks."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from ggslam.system.interrupts import STOPPING
from ggslam.system.tuning import Tuning


class PauseTuning(Tuning):
    """How a run is held."""

    look_s = 0.05
    """Seconds between two looks at what is to be done meanwhile."""


class Pause:
    """A run that calls `hold` between its frames stands still while this is on.

    Attributes:
        seconds: how long it was held, so far.
        times: how often.
    """

    def __init__(self) -> None:
        self._goes_on = threading.Event()
        self._goes_on.set()
        self.seconds, self.times = 0.0, 0

    @property
    def is_on(self) -> bool:
        """Whether the run is held, or will be after the frame in work."""
        return not self._goes_on.is_set()

    def switch(self, on: bool) -> None:
        """Holds the run, or lets it go on; in any thread."""
        if on:
            self._goes_on.clear()
        else:
            self._goes_on.set()

    def hold(self, meanwhile: Callable[[], None] = lambda: None) -> None:
        """Returns when the run may go on, or is to end; `meanwhile` is called again and again."""
        if self._goes_on.is_set():
            return
        began = time.monotonic()
        self.times += 1
        with _end_on_signal(self._goes_on):
            while not self._goes_on.wait(PauseTuning.look_s):
                meanwhile()
        self.seconds += time.monotonic() - began


@contextmanager
def _end_on_signal(goes_on: threading.Event) -> Iterator[None]:
    """A signal to stop ends the pause, and does what it would do without."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in STOPPING}

    def release(number: int, frame: FrameType | None) -> None:
        goes_on.set()
        earlier = before[signal.Signals(number)]
        if callable(earlier):
            earlier(number, frame)

    taken = [number for number, earlier in before.items() if callable(earlier)]
    for number in taken:
        signal.signal(number, release)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, before[number])
