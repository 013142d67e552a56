# SPDX-License-Identifier: Apache-2.0
"""Which processors each of several workers gets."""

from __future__ import annotations

import os

from ggslam.errors import ConfigError
from ggslam.native.loader import available_processors
from ggslam.system.tuning import Tuning


class ProcessorTuning(Tuning):
    """How processors are shared out."""

    per_worker = 2
    """Processors of a worker unless the number of workers is asked for: a run gains little from more."""


def shares(workers: int | None) -> list[tuple[int, ...]]:
    """Numbers of the processors of each worker; without a number of workers, two for each.

    Raises:
        ConfigError: no worker.
    """
    there = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
    count = max(1, len(there) // ProcessorTuning.per_worker) if workers is None else workers
    if count < 1:
        raise ConfigError(f"`workers`: expected at least 1, found {workers}")
    each = max(1, len(there) // count)
    return [tuple(there[(k * each + i) % len(there)] for i in range(each)) for k in range(count)]


def own_threads() -> int:
    """Threads that a piece of work may compute with: Ray says it by a variable, workers of this machine by the
    processors that they are held to."""
    word = os.environ.get("OMP_NUM_THREADS", "")
    there = available_processors()
    return max(1, min(there, int(word))) if word.isdecimal() else there
