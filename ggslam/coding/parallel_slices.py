# SPDX-License-Identifier: Apache-2.0
"""Codes slices in several threads and returns results in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from ggslam.native.loader import available_processors

Result = TypeVar("Result")


def in_order(work: Callable[[int], Result], count: int, threads: int | None) -> Iterator[Result]:
    """What `work` makes of the numbers 0 to count, one after the other. A thread has one of them in its hands, and no
    more results wait than there are threads.

    Args:
        work: called by several threads; what it raises is raised here.
        count: of the numbers.
        threads: their number; None: one for each processor.
    """
    threads = min(threads or available_processors(), count)
    if threads <= 1:
        yield from map(work, range(count))
        return
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(threads, thread_name_prefix="slice") as pool:
        try:
            for number in range(count):
                waiting.append(pool.submit(work, number))
                if len(waiting) > threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
