# SPDX-License-Identifier: Apache-2.0
"""`ggslam changes` on runs: what it prints and writes, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam
from kept import session_folder
from small_runs import run_of

from ggslam.jobs.changes.stale_gaussians import own_keyframes
from ggslam.runs.records.keyframes import KeyframesRecord

pytest.importorskip("gtsam")


@pytest.fixture(scope="module")
def visits(room: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two runs of pieces of one recording: nothing changed between them."""
    folder = session_folder(tmp_path_factory) / "merging"
    return run_of(room, folder / "first", 0, 16), run_of(room, folder / "second", 8, 24)


@pytest.mark.long("two runs of a generated room are made and compared")
def test_nothing_is_invented_between_pieces_of_one_recording(visits: tuple[Path, Path], tmp_path: Path) -> None:
    done = ggslam("changes", *visits, "--out", tmp_path / "found")
    assert done.returncode == 0, done.stderr
    assert "nothing changed" in done.stdout and "told by ids" in done.stdout
    written = json.loads((tmp_path / "found" / "changes.json").read_text())
    assert written["changes"] == [] and written["ids_believed"] and written["stayed"] > 5
    assert [path.name for path in (tmp_path / "found").iterdir()] == ["changes.json"]


@pytest.mark.long("two runs are compared by scores, surfaces and objects")
def test_comparisons_of_runs_tell_changes_if_asked(visits: tuple[Path, Path], tmp_path: Path) -> None:
    done = ggslam("report", *visits, "--changes", "--out", tmp_path / "page.html")
    assert done.returncode == 0, done.stderr
    assert "Nothing was found that changed." in (tmp_path / "page.html").read_text()
    done = ggslam("compare", *visits, "--changes", "--out", tmp_path / "numbers.json")
    assert done.returncode == 0 and "nothing changed" in done.stdout, done.stderr
    told = json.loads((tmp_path / "numbers.json").read_text())["changes"]
    assert told["changes"] == [] and told["stayed"] > 5


def test_changes_are_between_two_runs(visits: tuple[Path, Path], tmp_path: Path) -> None:
    done = ggslam("report", visits[0], "--changes")
    assert done.returncode == 2 and "two runs" in done.stderr
    (tmp_path / "cloud.ply").write_text("ply\n")
    done = ggslam("compare", visits[0], tmp_path / "cloud.ply", "--changes")
    assert done.returncode == 2 and "cloud.ply" in done.stderr


@pytest.mark.parametrize("frames, own", [([-1, -1, 0, 5], [2, 3]), ([0, 4], [0, 1]), ([-1, -1], [0, 1]), ([], [])])
def test_keyframes_of_an_earlier_map_are_none_of_a_run(frames: list[int], own: list[int]) -> None:
    keyframes = [{"frame": frame, "T_world_camera": np.eye(4)} for frame in frames]
    assert list(own_keyframes(KeyframesRecord.of({"keyframes": keyframes, "frames": []}))) == own


def test_what_cannot_be_compared_is_refused(visits: tuple[Path, Path], tmp_path: Path) -> None:
    done = ggslam("changes", visits[0], visits[0])
    assert done.returncode == 2 and "given twice" in done.stderr
    done = ggslam("changes", visits[0], tmp_path / "nothing")
    assert done.returncode == 2 and "nothing" in done.stderr
    (tmp_path / "file").write_text("")
    done = ggslam("changes", *visits, "--out", tmp_path / "file")
    assert done.returncode == 2 and "cannot be made" in done.stderr
    done = ggslam("changes", *visits, "--out", visits[0])
    assert done.returncode == 2 and "is a run" in done.stderr and not (visits[0] / "changes.json").exists()
