# SPDX-License-Identifier: Apache-2.0
"""One writer at a time: others wait, and are told whom for."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ggslam.errors import RunFolderError
from ggslam.system.folder_lock import folder_lock, output_lock

HOLD = """
import sys, time
from pathlib import Path
from ggslam.system.folder_lock import folder_lock, output_lock
with (output_lock if sys.argv[1] == "output" else folder_lock)(Path(sys.argv[2])):
    print("locked", flush=True)
    time.sleep(float(sys.argv[3]))
    Path(sys.argv[4]).write_text("done")
"""


@contextmanager
def holder(kind: str, path: Path, seconds: float, done: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that holds a lock, leaves a file when it is done, and is gone afterwards."""
    words = [sys.executable, "-c", HOLD, kind, str(path), str(seconds), str(done)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "locked\n"
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.parametrize("kind", ["folder", "output"])
def test_the_second_waits_for_the_first(tmp_path: Path, kind: str) -> None:
    path, done = (tmp_path if kind == "folder" else tmp_path / "map.ply"), tmp_path / "done"
    with holder(kind, path, 0.7, done):
        assert not done.exists()
        with folder_lock(path, wait_s=60) if kind == "folder" else output_lock(path):
            assert done.read_text() == "done"
    assert [found.name for found in tmp_path.iterdir()] == ["done"]


@pytest.mark.parametrize(("kind", "said"), [("folder", "is writing a run there"), ("output", "map.ply: process")])
def test_who_does_not_wait_any_longer_says_whom_for(
    tmp_path: Path, kind: str, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path if kind == "folder" else tmp_path / "map.ply"
    with holder(kind, path, 60, tmp_path / "done") as process:
        start = time.monotonic()
        lock = folder_lock(path, wait_s=2.5) if kind == "folder" else output_lock(path, wait_s=2.5)
        with pytest.raises(RunFolderError, match=said) as refused, lock:
            pass
        assert 2.5 <= time.monotonic() - start < 20 and f"process {process.pid} is" in str(refused.value)
        told = [record.getMessage() for record in caplog.records]
        assert len(told) == 1 and told[0].endswith("; waiting for it") and str(process.pid) in told[0]
    with folder_lock(path) if kind == "folder" else output_lock(path, 0):  # whoever was killed holds nothing
        pass


def test_outputs_of_other_names_do_not_wait(tmp_path: Path) -> None:
    with holder("output", tmp_path / "map.ply", 60, tmp_path / "done"):
        for name in ("mesh.ply", "map.glb", "new/map.ply"):
            with output_lock(tmp_path / name, 0), output_lock(tmp_path / name, 0):
                pass
    assert {found.name for found in tmp_path.iterdir()} <= {".map.ply.lock"}


def test_a_lock_that_is_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / ".map.ply.lock").symlink_to(tmp_path / "mine.txt")
    (tmp_path / ".lock").symlink_to(tmp_path / "mine.txt")
    for lock in (output_lock(tmp_path / "map.ply"), folder_lock(tmp_path)):
        with pytest.raises(RunFolderError, match="cannot be written to"), lock:
            pass
    assert (tmp_path / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize("kind", ["folder", "output"])
def test_a_lock_that_is_somebodys_file_is_not_written(tmp_path: Path, kind: str) -> None:
    mine, folder = tmp_path / "mine.txt", tmp_path / "run"
    folder.mkdir()
    mine.write_text("my thesis")
    name = ".lock" if kind == "folder" else ".map.ply.lock"
    (folder / name).hardlink_to(mine)
    lock = folder_lock(folder) if kind == "folder" else output_lock(folder / "map.ply")
    with pytest.raises(RunFolderError, match="has another name on this disk") as refused, lock:
        pass
    assert mine.read_text() == "my thesis" and refused.value.exit_code == 2 and str(folder / name) in str(refused.value)
    (folder / name).unlink()
    with folder_lock(folder), output_lock(folder / "map.ply"):
        assert mine.read_text() == "my thesis"


def test_a_lock_that_is_a_pipe_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / ".lock")
    with pytest.raises(RunFolderError, match="not a regular file"), folder_lock(tmp_path):
        pass
