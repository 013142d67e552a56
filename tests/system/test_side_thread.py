# SPDX-License-Identifier: Apache-2.0
"""Work beside the thread that asks for it."""

from __future__ import annotations

import gc
import multiprocessing
import threading
import time

import pytest

from ggslam.system.side_thread import SideThread


def test_work_is_done_beside_its_owner_and_errors_reach_it() -> None:
    side, go_on = SideThread[int]("beside"), threading.Event()

    def wait_and_tell() -> int:
        assert go_on.wait(10)  # set by the owner, after it has started this
        return threading.get_ident()

    assert not side.is_asked
    side.start(wait_and_tell)
    assert side.is_asked
    go_on.set()
    thread = side.take()
    assert thread != threading.get_ident() and not side.is_asked
    side.start(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        side.take()
    side.start(threading.get_ident)
    assert side.take() == thread


def test_the_thread_ends_with_its_owner() -> None:
    side = SideThread[int]("ends with its owner")
    side.start(lambda: 1)
    assert side.take() == 1
    (thread,) = [thread for thread in threading.enumerate() if thread.name == "ends with its owner"]
    del side
    gc.collect()
    thread.join(10)
    assert not thread.is_alive()


def test_a_forked_process_does_the_work_itself() -> None:
    side = SideThread[int]("forked")
    side.start(lambda: time.sleep(0.05) or 7)

    def child() -> None:
        assert side.take() == 7
        side.start(lambda: 8)
        assert side.take() == 8

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    process.join(30)
    assert process.exitcode == 0
    assert side.take() == 7
