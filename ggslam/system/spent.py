# SPDX-License-Identifier: Apache-2.0
"""What each part of a program used: seconds, seconds of processors, joules.

    spent = Spent(EnergyMeter())
    with spent.count_parts("the rest"):
        with part("tracking"):
            ...

Whatever runs inside a part counts for that part and no other, so parts add up to the whole. `part` does nothing in a
program, or a thread, that is not counted. What another thread does beside the counted one has parts of its own
(`count_beside`), which do not join that sum.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ContextDecorator, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeVar

from ggslam.system.energy import EnergyMeter


@dataclass
class Used:
    """What one part used: seconds of wall time, seconds of all of this process's threads on a processor, joules of the
    whole machine meanwhile (0 where they cannot be read)."""

    seconds: float = 0.0
    cpu_s: float = 0.0
    joules: float = 0.0


class ThreadParts:
    """Counts what the parts of one thread use, its own processor seconds alone and no joules."""

    def __init__(self) -> None:
        self._parts = dict[str, Used]()
        self._open: list[str] = []
        self._last = (0.0, 0.0, 0.0)

    @contextmanager
    def count_parts(self, rest: str) -> Iterator[None]:
        """Counts the block's parts, in this thread.

        Args:
            rest: the part of what is in no other.
        """
        self._last = self._now()
        token = _COUNTED.set(self)
        try:
            with self.part(rest):
                yield
        finally:
            _COUNTED.reset(token)

    @contextmanager
    def part(self, name: str, whole: bool = False) -> Iterator[None]:
        """Counts the block for `name`. `whole`: and whatever parts it has, because they run side by side."""
        self._lap()
        self._open.append(name)
        self._parts.setdefault(name, Used())
        token = _COUNTED.set(None) if whole else None
        try:
            yield
        finally:
            if token is not None:
                _COUNTED.reset(token)
            self._lap()
            self._open.pop()

    def so_far(self) -> dict[str, Used]:
        """What each part used until now, in the order of their first begin."""
        self._lap()
        return {name: replace(used) for name, used in self._parts.items()}

    def _lap(self) -> None:
        """What was used since the last call goes to the innermost open part."""
        now = self._now()
        if self._open:
            used = self._parts[self._open[-1]]
            used.seconds += now[0] - self._last[0]
            used.cpu_s += now[1] - self._last[1]
            used.joules += now[2] - self._last[2]
        self._last = now

    @cached_property
    def beside(self) -> ThreadParts:
        """What another thread uses beside this one, see `count_beside`; read it while that does nothing. Of this
        thread's processor seconds and joules, if these are of the whole process or machine, it is a share."""
        return ThreadParts()

    def _now(self) -> tuple[float, float, float]:
        """Seconds, processor seconds and joules so far."""
        return time.perf_counter(), time.thread_time(), 0.0


class Spent(ThreadParts):
    """Counts what the parts use, whatever threads work meanwhile.

    Attributes:
        meter: where joules come from.

    Args:
        meter: see above.
    """

    def __init__(self, meter: EnergyMeter) -> None:
        super().__init__()
        self.meter = meter

    @contextmanager
    def count_parts(self, rest: str) -> Iterator[None]:
        """See `ThreadParts`."""
        with self.meter.watch(), super().count_parts(rest):
            yield

    def _now(self) -> tuple[float, float, float]:
        return time.perf_counter(), time.process_time(), self.meter.joules() or 0.0


_COUNTED: ContextVar[ThreadParts | None] = ContextVar("counted", default=None)
Result = TypeVar("Result")


def count_beside(work: Callable[[], Result], rest: str) -> Callable[[], Result]:
    """Work for another thread, one piece at a time, whose parts count for `ThreadParts.beside` of this thread, if it is
    counted. `rest` is the part of what is in no other."""
    counted = _COUNTED.get()
    if counted is None:
        return work
    beside = counted.beside

    def count() -> Result:
        with beside.count_parts(rest):
            return work()

    return count


class part(ContextDecorator):
    """The block is a part of what `Spent.count_parts` counts, if this thread is counted; else nothing.

    Args:
        name, whole: see `Spent.part`.
    """

    def __init__(self, name: str, whole: bool = False) -> None:
        self._name, self._whole = name, whole
        self._counted: AbstractContextManager[None] | None = None

    def __enter__(self) -> None:
        spent = _COUNTED.get()
        if spent is not None:
            self._counted = spent.part(self._name, self._whole)
            self._counted.__enter__()

    def __exit__(self, *error: Any) -> None:
        if self._counted is not None:
            counted, self._counted = self._counted, None
            counted.__exit__(*error)
