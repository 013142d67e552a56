# SPDX-License-Identifier: Apache-2.0
"""A program from its first to its last moment: a signal to stop ends it with 128 + its number also while modules are
still loaded and while the interpreter tidies up, where Python itself dies of it or loses it."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Final, NoReturn

from ggslam.system.interrupts import STOPPING

_UNFLUSHED: Final = 120
"""Python's own exit status if the last of the output could not be written."""


def run_program(main: Callable[[], object]) -> NoReturn:
    """Runs a program and ends the process: what the interpreter does at the end, but without freeing what the system
    frees anyway (half a second with PyTorch loaded).

    Args:
        main: the program; what it loads itself is loaded after signals are seen to.
    """
    _end_on(STOPPING[1:], (signal.SIG_DFL,))  # Ctrl-C is Python's own until the end
    code = _code_of(main)
    _end_on(STOPPING, (signal.SIG_DFL, signal.default_int_handler))
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    os._exit(code if _flush() else code or _UNFLUSHED)


def _end_on(numbers: tuple[signal.Signals, ...], replaced: tuple[object, ...]) -> None:
    """Signals end the process at once, unless somebody else sees to them or they are to be ignored (nohup)."""
    for number in numbers:
        if signal.getsignal(number) in replaced:
            signal.signal(number, _end)


def _end(number: int, _: FrameType | None) -> None:
    os._exit(128 + number)


def _code_of(main: Callable[[], object]) -> int:
    """The exit code that Python would give the process."""
    try:
        main()
        return 0
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            return end.code or 0
        print(end.code, file=sys.stderr)
        return 1
    except BaseException as error:
        sys.excepthook(type(error), error, error.__traceback__)
        return 128 + signal.SIGINT if isinstance(error, KeyboardInterrupt) else 1


def _flush() -> bool:
    """Whether all that was printed is written."""
    good = True
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError, AttributeError):
            good = False
    return good
