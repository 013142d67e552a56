# SPDX-License-Identifier: Apache-2.0
"""Faults of what moves files, for fault_table.py: links in folders from elsewhere, files that may only be so large, two
commands at once, kills and signals at the last moment, forks."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from fault_disk import fallback

if TYPE_CHECKING:
    from fault_bench import Place

STAGED = ".staged-1-00000000"


def victim(place: Place) -> Path:
    """A folder of the user, which nobody may touch."""
    folder = place.folder / "mine"
    (folder / "renders").mkdir(parents=True)
    for name in ("thesis.txt", "map.ply", "run.json", "renders/0.png"):
        (folder / name).write_text("mine")
    return folder


def interrupted(folder: Path, marker: str) -> Path:
    """Says that a saving was cut off; returns the hidden folder, which is not there."""
    path = folder / marker
    mark = json.loads(path.read_text()) if path.exists() else {"files": []}
    path.write_text(json.dumps({**mark, "saving": {"from": STAGED, "stale": []}}))
    return folder / STAGED


def linked_run(inner: str, *words: str) -> Callable[[Place], None]:
    """A run from elsewhere whose hidden folder, or something in it, is a link to a folder of the user."""

    def happen(place: Place) -> None:
        run, mine = place.run(), victim(place)
        staged = interrupted(run, "run.json")
        if inner:
            staged.mkdir()
            (staged / "run.json").write_text("{}")
            (staged / inner).symlink_to(mine / inner)
        else:
            staged.symlink_to(mine)
        place.ggslam(*(run if word == "RUN" else word for word in words))

    return happen


def linked_volumes(place: Place) -> None:
    out, mine = place.folder / "volumes", victim(place)
    out.mkdir()
    interrupted(out, "volumes.json").symlink_to(mine)
    place.ggslam("volumes", place.run(), "--out", out, "--voxel", "0.1")


def linked_checkpoints(place: Place) -> None:
    recording = place.recording()
    place.map_recording(recording, "--checkpoint-every", "3", after=lambda k: os.kill(os.getpid(), 9) if k == 8 else 0)
    place.ended.clear()
    stranger = place.folder / "stranger"
    stranger.mkdir()
    (stranger / "checkpoints").symlink_to(place.out / "checkpoints")
    place.ggslam("run", "--resume", stranger)


def limited(size: int, *more: str) -> Callable[[Place], None]:
    """Files may only have so many bytes (`ulimit -f`) from some frame on, here and wherever else there is room."""

    def limit(frame: int) -> None:
        if frame == 6:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))

    def happen(place: Place) -> None:
        recording = place.recording()
        if more:
            place.map_recording(recording, "--stop", "6")
        with fallback(place.folder / "fallback"):
            place.map_recording(recording, *more, after=limit)

    return happen


@contextlib.contextmanager
def program(text: str, *words: object) -> Iterator[subprocess.Popen[str]]:
    """A Python program of its own."""
    command = [sys.executable, "-c", text, *map(str, words)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(command, text=True, **pipes) as process:  # type: ignore[call-overload]
        try:
            yield process
        finally:
            process.kill()


def run_program(place: Place, text: str, *words: object) -> None:
    """Notes how a program of its own ended, as of a command."""
    from fault_bench import Ended

    with program(text, *words) as process:
        try:
            said = process.communicate(timeout=100)[0]
        except subprocess.TimeoutExpired:
            place.ended.append(Ended(-signal.SIGALRM, ""))
            return
    place.ended.append(Ended(process.returncode, said))


HOLD = """
import sys, time
from pathlib import Path
from ggslam.system.folder_lock import output_lock
with output_lock(Path(sys.argv[1])):
    print("at it", flush=True)
    time.sleep(3)
    Path(sys.argv[1]).write_text("of the first")
"""
LATE = """
import atexit, os, sys
from ggslam.__main__ import main
atexit.register(lambda: os.kill(os.getpid(), 15))
sys.argv = ["ggslam", *sys.argv[1:]]
main()
"""
FORKED = """
import multiprocessing, sys
import torch

def child():
    import ggslam
    sequence = ggslam.open_sequence(sys.argv[1])
    try:
        ggslam.Slam(sequence.camera).step(sequence.frame(0))
    except ggslam.GgslamError as error:
        print(f"error: {error}", flush=True)
        sys.exit(error.exit_code)

torch.set_num_threads(2)
(torch.rand(4_000_000).exp() + 1).sum()
process = multiprocessing.get_context("fork").Process(target=child)
process.start()
process.join(90)
code = process.exitcode
process.kill()
sys.exit(70 if code is None else code)
"""
KILLED = """
import os, sys
from ggslam.cli.main import main
from ggslam.jobs.refine.finished_cells import CellsDone
CellsDone.finish = lambda self: os.kill(os.getpid(), 9)
sys.argv = ["ggslam", *sys.argv[1:]]
main()
"""


def two_exports(place: Place) -> None:
    run, out = place.run(), place.folder / "map.ply"
    with program(HOLD, out) as first:
        assert first.stdout is not None and first.stdout.readline() == "at it\n"
        place.ggslam("export", run, "--out", out)
        first.wait(30)
    if out.read_bytes()[:3] == b"ply":
        place.keep("the file of the second, written after the first")


def late_signal(place: Place) -> None:
    run = place.run()
    run_program(place, LATE, "verify", run)
    place.keep("the run")


def forked(place: Place) -> None:
    run_program(place, FORKED, place.recording())
    place.keep("the recording")


def killed_refinement(place: Place) -> None:
    store = place.folder / "map.grid"
    made = place.ggslam("submaps", place.run(), "--out", store)
    assert made.code == 0, made.text
    few = ("refine", store, "--steps", "4", "--workers", "1")
    place.ended.clear()
    run_program(place, KILLED, *few)
    again = place.ggslam(*few)
    if "an earlier call had finished" in again.text and "trained" not in again.said:
        place.keep("all cells that were trained")


def device_for_recording(place: Place) -> None:
    place.ggslam("eval", place.run(), "--sequence", "/dev/zero")


FAULTS: dict[str, Callable[[Place], None]] = {
    "the hidden folder of a run is a link: verify": linked_run("", "verify", "RUN"),
    "the hidden folder of a run is a link: report": linked_run("", "report", "RUN"),
    "a picture in the hidden folder of a run is a link": linked_run("renders", "verify", "RUN", "--accept"),
    "the map in the hidden folder of a run is a link": linked_run("map.ply", "verify", "RUN"),
    "the hidden folder of volumes is a link": linked_volumes,
    "the checkpoints are a link to another run's": linked_checkpoints,
    "files are limited to 60 kB (ulimit -f) when a run is saved": limited(60_000),
    "files are limited to 60 kB when a run is replaced": limited(60_000, "--overwrite"),
    "a run is scored against a device": device_for_recording,
    "two exports of one name at once": two_exports,
    "SIGTERM while the interpreter ends": late_signal,
    "a fork after PyTorch was used": forked,
    "kill -9 after the last cell of a store was refined": killed_refinement,
}
