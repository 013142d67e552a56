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
    """What to do with what was found, or if nothing was for an error, and the step before which it is done."""

    finish: Callable[[Found], None]
    give_up: Callable[[], None]
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

    def start(
        self, work: Callable[[], Found], finish: Callable[[Found], None], give_up: Callable[[], None]
    ) -> None:  # fmt: skip
        """Starts `work` in the other thread, if none is under way. In this one `finish` is given its result, or
        `give_up` is called if it raised something."""
        assert self._under_way is None
        self._under_way = _UnderWay(finish, give_up, self._step + STEPS_BESIDE + 1)
        self._thread.start(work)

    def drop(self) -> None:
        """Waits for what is under way, if anything is, and forgets it, whatever it found or raised."""
        if self._under_way is not None:
            self._under_way = _UnderWay(lambda found: None, lambda: None, self._step)
            with suppress(Exception):
                self.end()

    def end(self) -> None:
        """Waits for what is under way, if anything is, and takes it over; raises what it raised, once. If waiting is
        interrupted, it stays under way."""
        under_way = self._under_way
        if under_way is None:
            return
        try:
            found = self._thread.take()
        except BaseException:
            if not self._thread.is_asked:  # the work raised it
                self._under_way = None
                under_way.give_up()
            raise
        self._under_way = None
        under_way.finish(found)
