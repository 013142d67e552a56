# SPDX-License-Identifier: Apache-2.0
"""Services: what both kinds of nodes do with requests."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from typing import Any, Final

from ggslam.errors import MiddlewareError
from ggslam.middleware.definitions import request_of, response_of
from ggslam.middleware.node import Qos
from ggslam.middleware.types import MessageTypes

log = logging.getLogger(__name__)
SERVICE_QOS: Final = Qos(depth=10)
"""ROS 2's profile for services."""
CLOSE_S: Final = 2.0
"""Longest wait for an answer that is still being made when a service closes."""


class Answers:
    """Answers the requests of a service one at a time, in a thread of its own.

    Attributes:
        failures: requests without an answer, because they were damaged or `answer` raised.
        last_failure: why the last one failed.
    """

    def __init__(self, name: str, types: MessageTypes, kind: str, answer: Callable[[Any], Any]) -> None:
        self.name = name
        self.failures = 0
        self.last_failure: Exception | None = None
        self._types, self._kind, self._answer = types, kind, answer
        self._waiting: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=f"answer {name}", daemon=True)
        self._thread.start()

    def put(self, job: Callable[[], None]) -> None:
        """Has a request answered in the thread of the service."""
        self._waiting.put(job)

    def response(self, content: bytes) -> bytes | None:
        """The response to a request, both as CDR; None: there is none, which is counted and written to the log."""
        try:
            request = self._types.decode(request_of(self._kind), content)
            return self._types.encode(response_of(self._kind), self._answer(request))
        except Exception as error:  # of the one who answers, whatever it is: the next request may be well
            self._note(error)
            return None

    def refuse(self, why: str) -> None:
        """Counts a request that is none."""
        self._note(MiddlewareError(why))

    def close(self) -> None:
        """Answers no more."""
        self._waiting.put(None)
        if threading.current_thread() is not self._thread:
            self._thread.join(CLOSE_S)

    def _note(self, error: Exception) -> None:
        self.failures += 1
        self.last_failure = error
        log.warning("%s: a request has no answer: %s: %s", self.name, type(error).__name__, error)

    def _run(self) -> None:
        while (job := self._waiting.get()) is not None:
            try:
                job()
            except Exception as error:  # of the network: whoever asked may be gone
                self._note(error)
            del job  # what it holds of the network ends with it
