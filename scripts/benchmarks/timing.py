# SPDX-License-Identifier: Apache-2.0
"""Timing of calls, for the benchmarks."""

from __future__ import annotations

import time
from collections.abc import Callable


def seconds(call: Callable[[], object], repeats: int) -> list[float]:
    """How long each of the repeats took."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return times
