# SPDX-License-Identifier: Apache-2.0
"""A background thread that works on its latest request only."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

Request = TypeVar("Request")


class BackgroundLoader(Generic[Request]):
    """Runs `steps(request)` one by one in a thread; a new request, or `close`, ends what is left of the last one.

    Args:
        steps: gives, for a request, the steps to take, each a function without arguments.
    """

    def __init__(self, steps: Callable[[Request], Iterable[Callable[[], None]]]) -> None:
        self._steps = steps
        self._request: Request | None = None
        self._busy = False
        self._closing = False
        self._error: BaseException | None = None
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="cells-ahead", daemon=True)
        self._thread.start()

    def request(self, request: Request) -> None:
        """Takes the place of the last request. Raises what went wrong with an earlier one."""
        with self._changed:
            error, self._error = self._error, None
            if error is not None:
                raise error
            self._request = request
            self._changed.notify_all()

    def wait(self, timeout: float | None = None) -> bool:
        """Waits, at most `timeout` seconds, until nothing is left to do; returns whether that is so."""
        with self._changed:
            return self._changed.wait_for(lambda: self._request is None and not self._busy, timeout)

    def close(self) -> None:
        """Ends the thread after the step that it is at."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while (request := self._next()) is not None:
            try:
                for step in self._steps(request):
                    if self._overtaken():
                        break
                    step()
            except Exception as error:  # for whoever asks next: a thread has nobody to raise to
                with self._changed:
                    self._error = error

    def _next(self) -> Request | None:
        with self._changed:
            self._busy = False
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._closing or self._request is not None)
            if self._closing:
                return None
            request, self._request = self._request, None
            self._busy = True
            return request

    def _overtaken(self) -> bool:
        with self._changed:
            return self._closing or self._request is not None
