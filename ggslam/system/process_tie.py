# SPDX-License-Identifier: Apache-2.0
"""Processes and those that made them: which end together, and which are still at work."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import Final

_DIE_WITH_PARENT: Final = 1
"""PR_SET_PDEATHSIG of Linux's prctl."""


def die_with(parent: int) -> None:
    """Has Linux kill this process when its parent dies, however that happens; elsewhere nothing.

    To be called by the process itself: a function between fork and exec is not safe in a parent with threads.

    Args:
        parent: its process number; if it has died already, this process ends at once.
    """
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, int(signal.SIGKILL), 0, 0, 0)
        if os.getppid() != parent:
            sys.exit(1)


def is_running(process: int) -> bool:
    """Whether a process of this number runs on this machine; also if it is somebody else's, or no number of a
    process."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
