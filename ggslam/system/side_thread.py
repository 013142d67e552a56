# SPDX-License-Identifier: Apache-2.0
"""A thread that works beside the one that asks, a piece at a time. Handing work over takes microseconds, a tenth of
what executors of `concurrent.futures` take: for work of every frame."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any, Generic, TypeVar

Result = TypeVar("Result")


class SideThread(Generic[Result]):
    """Does a piece of work while its owner, one thread, does another. The thread starts with the first piece and ends
    with this object.

    Args:
        name: of the thread.
    """

    def __init__(self, name: str) -> None:
        self._name, self._process = name, 0
        self._asked: SimpleQueue[Callable[[], Result] | None] = SimpleQueue()
        self._done: SimpleQueue[tuple[Result | None, BaseException | None]] = SimpleQueue()
        self._work: Callable[[], Result] | None = None
        self.is_asked = False
        """Whether there is a result to take."""

    def start(self, work: Callable[[], Result]) -> None:
        """Starts a piece of work; its result has to be taken before the next is started."""
        if self._process != os.getpid():  # the first piece, or a fork: the thread stayed in the parent
            self._process, self._asked, self._done = os.getpid(), SimpleQueue(), SimpleQueue()
            target = (self._asked, self._done)
            threading.Thread(target=_work, args=target, name=self._name, daemon=True).start()
        self._work, self.is_asked = work, True
        self._asked.put(work)

    def take(self) -> Result:
        """The result of the piece that was started; waits for it, and raises what it raised."""
        work = self._work
        assert work is not None
        if self._process != os.getpid():
            self._work, self.is_asked = None, False
            return work()
        result, error = self._done.get()
        self._work, self.is_asked = None, False  # not if waiting was interrupted: the result is still to be taken
        if error is not None:
            raise error
        return result  # type: ignore[return-value]

    def __del__(self) -> None:
        self._asked.put(None)


def _work(asked: SimpleQueue[Any], done: SimpleQueue[Any]) -> None:
    while (work := asked.get()) is not None:
        try:
            done.put((work(), None))
        except BaseException as error:  # noqa: BLE001 - whoever asked gets it
            done.put((None, error))
