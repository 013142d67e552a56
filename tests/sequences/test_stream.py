# SPDX-License-Identifier: Apache-2.0
"""Reading ahead: order, bound, errors in their place, and an end of the thread."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from ggslam.errors import SequenceError
from ggslam.sequences import open_sequence
from ggslam.sequences.stream import ReadAhead


def reading_threads() -> int:
    return sum(thread.name == "ggslam-read-ahead" for thread in threading.enumerate())


def wait_until(condition: Callable[[], bool]) -> bool:
    end = time.monotonic() + 5
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.005)
    return True


@pytest.mark.parametrize("prefetch", [1, 4, 200])
def test_order(prefetch: int) -> None:
    assert list(ReadAhead(lambda i: i * i, 100, prefetch)) == [i * i for i in range(100)]
    assert wait_until(lambda: reading_threads() == 0)


def test_never_more_than_asked_for() -> None:
    started: list[int] = []
    stream = ReadAhead(lambda i: started.append(i) or i, 50, 3)
    assert wait_until(lambda: len(started) == 3)
    time.sleep(0.05)
    assert len(started) == 3
    assert next(stream) == 0
    assert wait_until(lambda: len(started) == 4)
    stream.close()
    assert reading_threads() == 0
    assert list(stream) == []


def test_error_comes_at_its_place() -> None:
    def read(i: int) -> int:
        if i == 3:
            raise SequenceError("frame 3")
        return i

    seen = []
    stream = ReadAhead(read, 6, 2)
    with pytest.raises(SequenceError, match="frame 3"):
        for item in stream:
            seen.append(item)
    assert seen == [0, 1, 2]
    assert list(stream) == [] and reading_threads() == 0


def test_thread_ends_when_collected() -> None:
    stream = ReadAhead(lambda i: i, 1000, 2)
    next(stream)
    assert reading_threads() == 1
    del stream
    gc.collect()
    assert wait_until(lambda: reading_threads() == 0)


def test_abandoned_sequence_stream(make: Callable[[str], Path]) -> None:
    sequence = open_sequence(make("replica"))
    frames = sequence.stream(prefetch=2)
    next(frames)
    assert reading_threads() == 1
    frames.close()  # type: ignore[attr-defined]
    assert reading_threads() == 0
    for _ in sequence.stream():
        break
    gc.collect()
    assert wait_until(lambda: reading_threads() == 0)


def test_without_thread(make: Callable[[str], Path]) -> None:
    sequence = open_sequence(make("replica"))
    direct = [frame.color.tobytes() for frame in sequence.stream(prefetch=0)]
    assert direct == [frame.color.tobytes() for frame in sequence.stream()] and len(direct) == 5
