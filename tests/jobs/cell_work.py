# SPDX-License-Identifier: Apache-2.0
"""Work for workers in tests; it lies in a module of its own so that they find it."""

from __future__ import annotations

import os
import signal
from pathlib import Path


def square(number: int) -> int:
    """What a worker can do."""
    if number < 0:
        raise ValueError("negative")
    return number * number


def die_once(task: tuple[str, int]) -> int:
    """Kills its process the first time it is asked: the file says whether it was."""
    path, number = Path(task[0]), task[1]
    if number == 2 and not path.exists():
        path.write_text("died")
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die_always(number: int) -> int:
    """Never comes back with an even number."""
    if number % 2 == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return number
