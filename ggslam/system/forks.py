# SPDX-License-Identifier: Apache-2.0
"""Forked processes (`multiprocessing` with "fork", `os.fork`): the threads that OpenMP, and with it PyTorch, keeps for
the next loop stay in the parent, and GNU's OpenMP would wait for them in the child forever.

So `rest_before_forks` lets the forking thread's helpers end before a fork; both processes start new ones when they need
some. Where that came too late, because ggslam was imported after the fork, `refuse_lost_threads` finds out.
"""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final

from ggslam.errors import NativeCoreError
from ggslam.system.tuning import Tuning

_PAUSE_HARD: Final = 2
"""`omp_pause_hard` of OpenMP 5."""
_FORKED_WITHOUT_EXEC: Final = 0x40
"""PF_FORKNOEXEC of the flags in /proc/self/stat."""


class ForkTuning(Tuning):
    """How a fork is tried."""

    probe_s = 2.0
    """Seconds after which letting the threads go counts as hanging."""


_good_process: int = 0
"""The process of which is known that no thread was lost to it by a fork."""
_rested = False


def rest_before_forks() -> None:
    """From now on forks lose no threads of OpenMP. Costs nothing until there is a fork, and then a few milliseconds."""
    global _good_process
    if not _was_forked():
        _good_process = os.getpid()
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(before=_rest, after_in_child=_note_fork)


def refuse_lost_threads() -> None:
    """Looks once in a process whether PyTorch's loops would wait for threads that stayed in the parent.

    Raises:
        NativeCoreError: they would; says what to do.
    """
    global _good_process
    if _good_process == os.getpid():
        return
    if _was_forked() and _would_hang():
        raise NativeCoreError(
            "this process was forked off one that had used PyTorch, whose threads it does not have: it would wait for "
            "them forever. Start it with multiprocessing.get_context('spawn'), or import ggslam before the fork"
        )
    _good_process = os.getpid()


def _rest() -> None:
    global _rested
    _rested = _good_process == os.getpid() and all(pause() == 0 for pause in _pauses())


def _note_fork() -> None:
    global _good_process
    if _rested:
        _good_process = os.getpid()


def _was_forked() -> bool:
    try:
        stat = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        return bool(int(stat[6]) & _FORKED_WITHOUT_EXEC)
    except (OSError, ValueError, IndexError):  # no Linux: no GNU OpenMP either, as a rule
        return False


def _pauses() -> list[Callable[[], int]]:
    """Of each GNU OpenMP that is loaded what lets the threads go that serve the calling thread."""
    found: list[Callable[[], int]] = []
    with suppress(OSError):
        names = {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if "libgomp" in line}
        for name in sorted(names):
            with suppress(OSError, AttributeError):  # AttributeError: older than OpenMP 5
                pause = ctypes.CDLL(name, mode=os.RTLD_NOLOAD | os.RTLD_NOW).omp_pause_resource_all
                found.append(partial(pause, _PAUSE_HARD))
    return found


def _would_hang() -> bool:
    """Whether letting the threads go takes forever, tried in a process of its own, which may hang."""
    pauses = _pauses()
    if not pauses:
        return False
    probe = os.fork()
    if probe == 0:
        for pause in pauses:
            pause()
        os._exit(0)
    end = time.monotonic() + ForkTuning.probe_s
    while time.monotonic() < end:
        if os.waitpid(probe, os.WNOHANG)[0]:
            return False
        time.sleep(0.002)
    os.kill(probe, 9)
    os.waitpid(probe, 0)
    return True
