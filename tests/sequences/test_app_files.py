# SPDX-License-Identifier: Apache-2.0
"""Recordings as phones' apps write them give back the images and poses that they were written from."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from app_recordings import (
    PhoneFrame,
    hide_first_frame,
    phone_frames,
    write_record3d_2022,
    write_scanner_app,
    write_stray,
)
from format_makers import color_bgr, write_video

from ggslam.errors import SequenceError
from ggslam.sequences import Sequence, inspect_sequence, open_sequence, recognise_format
from ggslam.sequences.edit_list import count_hidden_frames
from ggslam.sequences.pose_doubts import doubt_poses, pairs_apart


@pytest.fixture(scope="module")
def frames() -> list[PhoneFrame]:
    """Colour of a sixth of a phone's size; the walk turns by a degree a frame."""
    return phone_frames(10, (320, 240), (256, 192), frames=240)


def assert_true(sequence: Sequence, frames: list[PhoneFrame]) -> None:
    """The frames of a sequence are these: times, poses, depth where it is sure, colour of the same moment, and all of
    them agree with one another."""
    assert len(sequence) == len(frames)
    assert sequence.ground_truth is not None
    assert np.diff(sequence.timestamps) == pytest.approx(np.diff([frame.time for frame in frames]), abs=1e-4)
    for i in (0, len(frames) // 2, len(frames) - 1):
        read, true = sequence.frame(i), frames[i]
        assert read.T_world_camera is not None
        np.testing.assert_allclose(read.T_world_camera, true.T_world_camera, atol=1e-5)
        size = (read.camera.width, read.camera.height)
        expected = true.camera.resize(*size)
        assert (read.camera.fx, read.camera.cx, read.camera.cy) == pytest.approx(
            (expected.fx, expected.cx, expected.cy)
        )
        sure = cv2.resize(np.where(true.confidence > 0, true.depth, 0), size, interpolation=cv2.INTER_NEAREST)
        same = np.abs(read.depth - sure) < 0.02 * sure + 6e-4
        assert same[sure > 0].mean() > 0.97 and (read.depth[sure == 0] == 0).mean() > 0.9
        around = range(max(0, i - 2), min(len(frames), i + 3))
        colors = [cv2.resize(frames[k].color, size, interpolation=cv2.INTER_AREA) for k in around]
        off = [np.abs(read.color.astype(int) - color).mean() for color in colors]
        assert around[int(np.argmin(off))] == i and min(off) < 5
    pairs = pairs_apart(sequence, [sequence.frame(0), sequence.frame(1)])
    doubt = doubt_poses(pairs)
    assert doubt is not None and doubt.error < 0.005 and not doubt.wrong_convention and not doubt.wrong_scale


def test_stray_scanner_as_the_app_writes_it(tmp_path: Path, frames: list[PhoneFrame]) -> None:
    """Empty columns, and a first frame that the edit list hides: frame n of the video is that of row n + 1."""
    folder = write_stray(tmp_path / "0b2a7c11f4", frames)
    assert recognise_format(folder) == "strayscanner"
    assert count_hidden_frames(folder / "rgb.mp4") == 1
    sequence = open_sequence(folder)
    assert_true(sequence, frames[1:])
    assert sequence.warnings == [
        "rgb.mp4 plays 9 frames for 10 rows of odometry.csv, as the app writes it: its first frame is hidden by an "
        "edit list, so row 0 is left out"
    ]
    assert inspect_sequence(sequence).verdicts == []


@pytest.mark.parametrize(("lacking", "kept"), [("first", slice(1, None)), ("last", slice(None, -1))])
def test_stray_scanner_encoded_anew(tmp_path: Path, frames: list[PhoneFrame], lacking: str, kept: slice) -> None:
    """Nothing but the images tells which frame lacks."""
    sequence = open_sequence(write_stray(tmp_path / "walk", frames, lacking))
    assert_true(sequence, frames[kept])
    assert len(sequence.warnings) == 1 and "plays 9 frames for 10 rows" in sequence.warnings[0]


def test_stray_scanner_that_is_whole_or_damaged(tmp_path: Path, frames: list[PhoneFrame]) -> None:
    folder = write_stray(tmp_path / "walk", frames, "none")
    assert_true(open_sequence(folder), frames)
    assert open_sequence(folder).warnings == []
    write_stray(tmp_path / "cut", frames, "none")
    short = write_stray(tmp_path / "short", frames[:7], "none")
    (short / "rgb.mp4").replace(tmp_path / "cut" / "rgb.mp4")
    with pytest.raises(SequenceError, match=r"rgb\.mp4 .*\b7 frames.*\b2 more"):
        open_sequence(tmp_path / "cut")
    table = (folder / "odometry.csv").read_text()
    (folder / "odometry.csv").write_text(table.replace("000003", "nan"))
    with pytest.raises(SequenceError, match=r"odometry\.csv, line 5: .*nan"):
        open_sequence(folder)


def test_edit_lists(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_video(path, [color_bgr(i) for i in range(4)])
    assert count_hidden_frames(path) == 0
    hide_first_frame(path)
    assert count_hidden_frames(path) == 1
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):  # a damaged file is no reason for anything but an answer
        path.write_bytes(whole[:length])
        assert count_hidden_frames(path) in (0, 1)
    rng = np.random.default_rng(0)
    for _ in range(300):
        content = bytearray(whole)
        for at in rng.integers(whole.index(b"moov"), len(whole), 4):
            content[at] = rng.integers(0, 256)
        path.write_bytes(content)
        assert 0 <= count_hidden_frames(path) <= 1 << 26
    assert count_hidden_frames(tmp_path / "none.mp4") == 0


def test_scanner_app_as_it_writes_it(tmp_path: Path, frames: list[PhoneFrame]) -> None:
    folder = write_scanner_app(tmp_path / "2026_01_13_14_47_59", frames)
    assert recognise_format(folder) == "3dscannerapp"
    sequence = open_sequence(folder)
    assert_true(sequence, frames[::2])
    assert sequence.warnings == ["5 of 10 frames are whole, as the app writes it; left out: 5 without colour"]
    assert sequence.min_confidence == 1 and (sequence.frame(0).depth[:, 0] == 0).all()
    assert (open_sequence(folder, min_confidence=0).frame(0).depth[:, 0] > 0).mean() > 0.9
    assert inspect_sequence(sequence).verdicts == []


def test_scanner_app_that_lacks_something(tmp_path: Path, frames: list[PhoneFrame]) -> None:
    folder = write_scanner_app(tmp_path / "scan", frames[:6], color_every=1)
    (folder / "depth_00001.png").unlink()
    (folder / "frame_00003.json").unlink()
    sequence = open_sequence(folder)
    assert len(sequence) == 4
    assert sequence.warnings == [
        "4 of 6 frames are whole, as the app writes it; left out: 1 without depth, 1 without JSON"
    ]
    path = folder / "frame_00004.json"
    entries = json.loads(path.read_text())
    path.write_text(json.dumps({**entries, "intrinsics": [1, 2]}))
    with pytest.raises(SequenceError, match=r"frame_00004\.json: .*9 .*'intrinsics'"):
        open_sequence(folder)
    path.write_text(json.dumps({**entries, "cameraPoseARFrame": [1.0] * 16}))
    poses = open_sequence(folder).ground_truth
    assert poses is not None and np.isnan(poses).any((1, 2)).sum() == 1
    assert "frame_00004.json: pose is not a rigid transform" in open_sequence(folder).warnings[-1]
    for path in folder.glob("frame_*.jpg"):
        path.unlink()
    with pytest.raises(
        SequenceError, match="0 color, 5 depth, 5 json"
    ):
        open_sequence(folder)


def test_record3d_of_2022(tmp_path: Path) -> None:
    """Portrait, and neither `dh` nor `dw`."""
    frames = phone_frames(4, (240, 320), (192, 256), frames=120, focal=1.3)
    sequence = open_sequence(write_record3d_2022(tmp_path / "walk.r3d", frames))
    assert sequence.depth_size == (192, 256)
    assert_true(sequence, frames)
    assert sequence.warnings == []


def test_record3d_of_2022_with_depth_of_no_shape(tmp_path: Path) -> None:
    frames = phone_frames(1, (240, 320), (191, 256), frames=120)
    path = write_record3d_2022(tmp_path / "walk.r3d", frames)
    with pytest.raises(
        SequenceError, match=r"'dh' and 'dw' .*48896.*rgbd/0\.depth"
    ):
        open_sequence(path)
