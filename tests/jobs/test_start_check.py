# SPDX-License-Identifier: Apache-2.0
"""A run looks at depth before it begins: it refuses what is certainly wrong, and says what is doubtful."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import pytest
from command_line import ggslam, refuse

from ggslam.jobs.progress import SilentObserver
from ggslam.jobs.run.health import doubt_movers
from ggslam.jobs.run.start_check import check_depth
from ggslam.sequences import open_sequence
from ggslam.sequences.verdicts import Verdict


class Notes(SilentObserver):
    def __init__(self) -> None:
        self.texts: list[str] = []

    def note(self, text: str) -> None:
        self.texts.append(text)


@pytest.fixture(scope="module")
def mirror(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mirror") / "room"
    shutil.copytree(room, folder)
    for path in (folder / "depth").iterdir():
        assert cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:, ::-1])
    return folder


def test_certain_faults_are_refused(mirror: Path, tmp_path: Path) -> None:
    out, fast = tmp_path / "run", ("--set", "mapping.iterations_per_frame=0", "--refine", "0", "--no-eval")
    words = "depth or colour is mirrored", "text in the colour images reads backwards", "--depth-kind mirrored"
    refuse(ggslam("run", mirror, "--out", out, *fast), *words, "--no-check")
    assert not out.exists()
    done = ggslam("run", mirror, "--out", out, "--stop", 6, "--no-check", *fast)
    assert done.returncode == 0 and (out / "map.ply").is_file()
    mended = ggslam("run", mirror, "--out", tmp_path / "mended", "--stop", 6, "--depth-kind", "mirrored", *fast)
    assert mended.returncode == 0


def test_healthy_rooms_begin_without_a_word(room: Path) -> None:
    notes = Notes()
    assert check_depth(open_sequence(room), notes) == [] and notes.texts == []


def test_doubts_are_notes(room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "room"
    shutil.copytree(room, folder)
    for path in sorted((folder / "depth").iterdir())[1::2]:
        shutil.copy(path.with_name(f"{int(path.stem) - 1:06d}.png"), path)
    notes = Notes()
    assert "depth_repeats" in [verdict.code for verdict in check_depth(open_sequence(folder), notes)]
    assert any("depth images repeat" in text for text in notes.texts)


def test_void_ids_are_told_and_left_out(room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "room"
    shutil.copytree(room, folder)
    for path in (folder / "masks").iterdir():
        ids = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        ids[:, :6] = 255
        assert cv2.imwrite(str(path), ids)
    notes = Notes()
    check_depth(open_sequence(folder), notes)
    assert any("`void_id` 255" in text for text in notes.texts)
    left = open_sequence(folder, void_id=255)
    mask, true = left[3].mask, open_sequence(room)[3].mask
    assert mask is not None and true is not None
    assert (mask[:, :6] == 0).all() and (mask[:, 6:] == true[:, 6:]).all()
    assert check_depth(left, Notes()) == []


def test_movers_are_put_down_to_depth_first() -> None:
    notes = ["something moves in 13 of 20 frames: it is not mapped (movers.npz)", "another"]
    assert doubt_movers(notes, [Verdict("lost", "wrong", "")]) == notes
    changed = doubt_movers(notes, [Verdict("depth_kind", "wrong", "")])
    assert changed == [f"{notes[0]}; more likely depth is at fault, see below", "another"]
