# SPDX-License-Identifier: Apache-2.0
"""Copies of a map that another thread adds to, and questions that fail: neither ends the run."""

from __future__ import annotations

import threading
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from ggslam.errors import ConfigError
from ggslam.jobs.serve.live_functions import LiveFunctions, LiveFunctionTuning
from ggslam.slam.map_copy import MapCopyTuning, whole_map
from ggslam.slam.slam import Slam
from ggslam.system.tuning import overridden


class GrowingMap:
    """Grows while it is copied, so many times."""

    def __init__(self, times: int) -> None:
        self.left, self.count = times, 10

    def __len__(self) -> int:
        return self.count

    def copy(self, device: str) -> list[int]:
        found = list(range(self.count))
        if self.left:
            self.left -= 1
            self.count += 1
            if self.left % 2:
                raise RuntimeError("The size of tensor a (10) must match the size of tensor b (11)")
        return found


def slam_of(times: int) -> Slam:
    return cast(Slam, SimpleNamespace(map=GrowingMap(times), mapper=SimpleNamespace(in_turn=nullcontext)))


def test_a_copy_is_whole() -> None:
    copy: Any = whole_map(slam_of(5))
    assert copy == list(range(15))
    with pytest.raises(ConfigError, match="ask again"):
        whole_map(slam_of(MapCopyTuning.tries + 1))


def test_a_question_that_fails_is_the_callers_and_the_run_goes_on() -> None:
    functions = LiveFunctions(cast(Any, None), cast(Any, None), Path())
    frames = SimpleNamespace(frames=[], dropped_frames=[])
    raised: list[BaseException] = []

    def ask() -> None:
        def fail(slam: Slam) -> None:
            raise IndexError("a fault of ours")

        try:
            functions._ask(fail)
        except IndexError as error:
            raised.append(error)

    caller = threading.Thread(target=ask)
    caller.start()
    while caller.is_alive():
        functions.between_frames(cast(Slam, frames))
    assert [str(error) for error in raised] == ["a fault of ours"]


def test_a_question_that_came_too_late_is_not_done_later() -> None:
    functions = LiveFunctions(cast(Any, None), cast(Any, None), Path())
    asked: list[Slam] = []
    with overridden(LiveFunctionTuning, copy_s=0.01), pytest.raises(ConfigError, match="no frame was done in 0.01 s"):
        functions._ask(asked.append)
    functions.between_frames(cast(Slam, SimpleNamespace(frames=[], dropped_frames=[])))
    assert not asked


def test_before_the_first_keyframe_there_is_no_map_to_save(tmp_path: Path) -> None:
    functions = LiveFunctions(cast(Any, None), cast(Any, None), tmp_path)
    frames: Any = SimpleNamespace(frames=[], dropped_frames=[], pager=None, mapper=SimpleNamespace(keyframes=[]))
    running = threading.Event()

    def run() -> None:
        while not running.wait(0.005):
            functions.between_frames(frames)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        with pytest.raises(ConfigError, match="there is no map yet"):
            functions.save_map({"name": "early"})
    finally:
        running.set()
        thread.join()
    assert not list(tmp_path.iterdir())
