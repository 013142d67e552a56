# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C, and what other programs send for it: SIGTERM (kill, a shutdown, a job that is out of time) and SIGHUP (the
terminal or the ssh session is gone). All three are one thing: stop, and save what there is."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from ggslam.system.tuning import Tuning

STOPPING = tuple(
    found for name in ("SIGINT", "SIGTERM", "SIGHUP") if (found := getattr(signal, name, None)) is not None
)


class InterruptTuning(Tuning):
    """When two signals are one request."""

    again_s = 1.0
    """Seconds after a signal in which others belong to it: whoever hangs up sends more than one."""


class Interrupted(KeyboardInterrupt):
    """As Ctrl-C, by another signal.

    Args:
        number: of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def exit_code(error: KeyboardInterrupt) -> int:
    """128 + the number of the signal, as shells count."""
    return 128 + (error.number if isinstance(error, Interrupted) else signal.SIGINT)


def interrupt_of(number: int) -> KeyboardInterrupt:
    """The exception that stands for a signal."""
    return KeyboardInterrupt() if number == signal.SIGINT else Interrupted(number)


class StopRequest:
    """Whether somebody wants the work to end after the step it is at.

    Attributes:
        number: of the signal that said so; None: nobody did.
    """

    def __init__(self, announce: Callable[[str], None] | None = None) -> None:
        self.number: int | None = None
        self._since = 0.0
        self._announce = announce

    def raise_if_any(self) -> None:
        """Raises KeyboardInterrupt (`Interrupted`) if there is a request."""
        if self.number is not None:
            raise interrupt_of(self.number)

    def note(self, number: int, _: FrameType | None = None) -> None:
        """A signal has come. The second one ends the process at once, as it would any other."""
        if number == getattr(signal, "SIGHUP", None):
            _let_go_of_the_terminal()
        if self.number is None:
            self.number, self._since = number, time.monotonic()
            if self._announce is not None:
                self._announce("stopping: what there is is saved (once more ends at once)")
        elif time.monotonic() - self._since > InterruptTuning.again_s:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)


_current: StopRequest | None = None


@contextmanager
def stop_on_request(announce: Callable[[str], None] | None = None) -> Iterator[StopRequest]:
    """Signals to stop cut nothing in two within the block: they are noted, and the block looks at them between its
    steps. Elsewhere than in the main thread none arrives; blocks may be nested, the outermost counts.

    Args:
        announce: is told once that the request was heard.
    """
    global _current
    if threading.current_thread() is not threading.main_thread():
        yield StopRequest()
        return
    if _current is not None:
        yield _current
        return
    request = StopRequest(announce)
    with _handlers(request.note):
        _current = request
        try:
            yield request
        finally:
            _current = None


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Signals to stop wait until the block is done (in the main thread; elsewhere they do not arrive anyway)."""
    if threading.current_thread() is not threading.main_thread() or _current is not None:
        yield  # within `stop_on_request` nothing is cut in two
        return
    arrived: list[int] = []
    with _handlers(lambda number, _: arrived.append(number)):
        yield
    if arrived:
        raise interrupt_of(arrived[0])


@contextmanager
def stop_like_ctrl_c() -> Iterator[None]:
    """Within the block SIGTERM and SIGHUP raise `Interrupted` where Ctrl-C raises KeyboardInterrupt."""

    def stop(number: int, _: FrameType | None) -> None:
        if number == getattr(signal, "SIGHUP", None):
            _let_go_of_the_terminal()
        raise Interrupted(number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with _handlers(stop, STOPPING[1:]):
        yield


@contextmanager
def _handlers(
    handler: Callable[[int, FrameType | None], object], numbers: tuple[signal.Signals, ...] = STOPPING
) -> Iterator[None]:
    """Signals go to a handler; those that the process was told to ignore (nohup) stay ignored."""
    before = {number: signal.getsignal(number) for number in numbers}
    taken = {number: old for number, old in before.items() if old not in (signal.SIG_IGN, None)}
    for number in taken:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in taken.items():
            signal.signal(number, old)


def _let_go_of_the_terminal() -> None:
    """What is printed to a terminal that is gone fails; it goes nowhere instead."""
    for stream in (sys.__stdout__, sys.__stderr__):
        with contextlib.suppress(OSError, ValueError, AttributeError):
            descriptor = stream.fileno()  # type: ignore[union-attr]
            if os.isatty(descriptor):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, descriptor)
                os.close(nowhere)
