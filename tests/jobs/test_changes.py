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

from ggslam.jobs.changes.changes import own_keyframes
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
