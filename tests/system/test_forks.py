# SPDX-License-Identifier: Apache-2.0
"""Forked processes: OpenMP's threads stay in the parent. Nothing waits for them forever."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

PRINT = """
import multiprocessing, os, sys

def child():
    import ggslam
    code = 1
    try:
        sequence = ggslam.open_sequence(sys.argv[1], scale=0.5, stop=2)
        settings = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=1"]
        slam = ggslam.Slam(sequence.camera, ggslam.load_config(None, settings))
        for frame in sequence:
            slam.step(frame)
        print("frames", len(slam.finish().frames), flush=True)
        code = 0
    except ggslam.GgslamError as error:
        print(f"{type(error).__name__}: {error}", flush=True)
    os._exit(code)

def use_torch():
    import torch
    (torch.rand(4_000_000).exp() + 1).sum()

def use_slam():
    import ggslam
    sequence = ggslam.open_sequence(sys.argv[1], scale=0.5, stop=2)
    slam = ggslam.Slam(sequence.camera, ggslam.load_config(None, ["mapping.first_frame_iterations=1"]))
    for frame in sequence:
        slam.step(frame)
    return slam

def fork(work):
    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    process.join(60)
    print("ended with", process.exitcode, flush=True)
    process.kill()
"""
PARENTS = {
    "nothing was used": ("import ggslam\nfork(child)", "frames 2"),
    "torch was used": ("import ggslam\nuse_torch()\nfork(child)", "frames 2"),
    "a Slam is there": ("kept = use_slam()\nfork(child)", "frames 2"),
    "a child of a child": ("import ggslam\nuse_torch()\nfork(lambda: (use_torch(), fork(child)))", "frames 2"),
    "ggslam comes after the fork": ("use_torch()\nfork(child)", "multiprocessing.get_context('spawn')"),
    "ggslam comes after the fork of a fresh process": ("fork(child)", "frames 2"),
    "and after two forks": ("use_torch()\nfork(lambda: fork(child))", "multiprocessing.get_context('spawn')"),
}


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="GNU's OpenMP and /proc")
@pytest.mark.parametrize("case", PARENTS)
def test_a_fork_maps_or_says_what_to_do(room: Path, case: str) -> None:
    program, expected = PARENTS[case]
    threads = {"OMP_NUM_THREADS": "2", "OMP_WAIT_POLICY": "PASSIVE"}
    words = [sys.executable, "-c", f"{PRINT}\n{program}", str(room)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=200, env={**os.environ, **threads})
    assert expected in done.stdout and "ended with None" not in done.stdout, (done.stdout, done.stderr)
    refused = "spawn" in expected
    assert ("NativeCoreError: this process was forked off" in done.stdout) == refused


def test_threads_of_the_core_are_made_anew() -> None:
    from ggslam.native.loader import NativeContext

    context = NativeContext(threads=2)
    before = context.handle.value
    child = os.fork()
    if child == 0:
        anew = context.handle.value not in (None, before)
        del context  # would wait for threads that are not there
        os._exit(0 if anew else 1)
    end = time.monotonic() + 20
    status = (0, 0)
    while time.monotonic() < end and not status[0]:
        status = os.waitpid(child, os.WNOHANG)
        time.sleep(0.01)
    if not status[0]:
        os.kill(child, 9)
        os.waitpid(child, 0)
    assert status[0] and os.waitstatus_to_exitcode(status[1]) == 0 and context.handle.value == before
