# SPDX-License-Identifier: Apache-2.0
"""A keyframe joins what frames are aligned to, and the search for loops, while the next frames are located."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Generic, TypeVar

from ggslam.system.side_thread import SideThread
from ggslam.system.tuning import Tuning

Found = TypeVar("Found")


class JoiningTuning(Tuning):
    """When the next frame does without a keyframe."""

    min_overlap = 0.75
    """Smallest overlap of the keyframe with what it was aligned to itself: the next frame sees still less of that."""


STEPS_BESIDE = 1
"""Steps beside which a keyframe joins. By then it has: on a GPU a step takes milliseconds, and so does this."""


@dataclass(frozen=True)
class _UnderWay(Generic[Found]):
    """What to do with what was found, and the step before which it is done."""

    finish: Callable[[Found], None]
    due: int


class Joining(Generic[Found]):
    """One keyframe's joining, in a thread of its own. When others see it is decided by the number of steps, never by
    how long it takes. One thread owns this, and nobody else may use what the work uses until it is taken over."""

    def __init__(self) -> None:
        self._thread: SideThread[Found] = SideThread("joining")
        self._under_way: _UnderWay[Found] | None = None
        self._step = 0

    @property
    def is_under_way(self) -> bool:
        """Whether a keyframe joins."""
        return self._under_way is not None

    def begin_step(self) -> None:
        """A step begins: a keyframe that has joined beside enough of them is taken over."""
        self._step += 1
        if self._under_way is not None and self._step >= self._under_way.due:
            self.end()

    def start(self, work: Callable[[], Found], finish: Callable[[Found], None]) -> None:
        """Starts `work` in the other thread, if none is under way; `finish` is given its result in this one."""
        assert self._under_way is None
        self._under_way = _UnderWay(finish, self._step + STEPS_BESIDE + 1)
        self._thread.start(work)

    def drop(self) -> None:
        """Waits for what is under way, if anything is, and forgets it, whatever it found or raised."""
        if self._under_way is not None:
            self._under_way = None
            with suppress(Exception):
                self._thread.take()

    def end(self) -> None:
        """Waits for what is under way, if anything is, and takes it over; raises what it raised."""
        under_way, self._under_way = self._under_way, None
        if under_way is not None:
            under_way.finish(self._thread.take())
