# SPDX-License-Identifier: Apache-2.0
"""Damaged and strange recordings: one clear line each, naming the file, what was expected and what was found."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from format_makers import make_icl_nuim, make_nerfcapture

from ggslam.errors import SequenceError
from ggslam.sequences import open_sequence
from ggslam.sequences.recording import last_number, natural_key

Make = Callable[[str], Path]


def read_all(folder: Path, **options: object) -> int:
    return sum(1 for _ in open_sequence(folder, **options).stream())  # type: ignore[arg-type]


def truncate(path: Path, share: float = 0.6) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])


def noisy_image(path: Path, depth: bool) -> None:
    rng = np.random.default_rng(0)
    shape, dtype = ((24, 32), np.uint16) if depth else ((24, 32, 3), np.uint8)
    assert cv2.imwrite(str(path), rng.integers(1, 255, shape).astype(dtype))


def replica_file(folder: Path, kind: str, i: int) -> Path:
    return folder / "results" / (f"frame{i:06d}.jpg" if kind == "frame" else f"depth{i:06d}.png")


def break_frame(folder: Path, damage: str) -> str:
    """Damages frame 3 of a Replica recording; returns what the message must say."""
    color, depth = replica_file(folder, "frame", 3), replica_file(folder, "depth", 3)
    if damage == "missing depth":
        depth.unlink()
        return r"frame 3: .*depth000003\.png is missing"
    if damage == "truncated png":
        noisy_image(depth, True)
        truncate(depth)
        return r"depth000003\.png: .*truncated"
    if damage == "truncated in the last bytes":
        noisy_image(depth, True)
        depth.write_bytes(depth.read_bytes()[:-12])
        return r"depth000003\.png: .*end marker"
    if damage == "flipped bit":
        noisy_image(depth, True)
        content = bytearray(depth.read_bytes())
        content[len(content) // 2] ^= 4
        depth.write_bytes(content)
        return r"depth000003\.png: .*checksum"
    if damage == "truncated jpg":
        noisy_image(color, False)
        truncate(color, 0.8)
        return r"frame000003\.jpg: .*truncated"
    if damage == "empty file":
        color.write_bytes(b"")
        return r"frame000003\.jpg: .*empty"
    if damage == "text file":
        color.write_text("not an image at all")
        return r"frame000003\.jpg: .*PNG or JPEG"
    if damage == "depth of another size":
        assert cv2.imwrite(str(depth), np.ones((12, 16), np.uint16))
        return r"depth000003\.png: .*32x24.*16x12"
    if damage == "8-bit depth":
        assert cv2.imwrite(str(depth), np.ones((24, 32), np.uint8))
        return r"depth000003\.png: .*16-bit.*8-bit"
    raise AssertionError(damage)


DAMAGES = (
    "missing depth", "truncated png", "truncated in the last bytes", "flipped bit", "truncated jpg", "empty file",
    "text file", "depth of another size", "8-bit depth",
)  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_frame(make: Make, damage: str) -> None:
    folder = make("replica")
    message = break_frame(folder, damage)
    with pytest.raises(SequenceError, match=message) as caught:
        read_all(folder)
    assert "\n" not in str(caught.value)
    sequence = open_sequence(folder, on_bad_frame="skip")
    assert [frame.source_index for frame in sequence.stream()] == [0, 1, 2, 4]
    (skipped,) = sequence.skipped_frames
    assert (skipped.index, skipped.source_index) == (3, 3)
    with pytest.raises(SequenceError, match=message):
        raise SequenceError(skipped.reason)
    assert read_all(folder, stop=3) == 3  # damage outside the selection does not matter


def test_first_frame_damaged(make: Make) -> None:
    folder = make("replica")
    replica_file(folder, "depth", 0).write_bytes(b"")
    with pytest.raises(SequenceError, match=r"depth000000\.png: .*empty"):
        open_sequence(folder)
    assert read_all(folder, on_bad_frame="skip") == 4
    for i in range(5):
        replica_file(folder, "depth", i).write_bytes(b"")
    with pytest.raises(SequenceError, match=r"\b5 frames.*depth000000\.png"):
        open_sequence(folder, on_bad_frame="skip")


def test_no_recording(tmp_path: Path) -> None:
    with pytest.raises(SequenceError, match=str(tmp_path / "nowhere")):
        open_sequence(tmp_path / "nowhere")
    (tmp_path / "file").write_text("x")
    with pytest.raises(SequenceError, match=f"{tmp_path / 'file'}.*found a file"):
        open_sequence(tmp_path / "file")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(SequenceError, match=f"{empty}.*holds nothing"):
        open_sequence(empty)
    (empty / "holiday.mp4").write_text("x")
    with pytest.raises(SequenceError, match=r"(?s)holiday\.mp4.*replica: results/frame") as caught:
        open_sequence(empty)
    assert all(name in str(caught.value) for name in ("tum:", "7scenes:", "scannet:", "folder:"))
    with pytest.raises(SequenceError, match="kitti.*replica"):
        open_sequence(empty, format="kitti")
    for name in ("replica", "tum", "7scenes", "scannet", "folder", "synthetic"):
        with pytest.raises(SequenceError):
            open_sequence(empty, format=name)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": 5}, "start.* 0 .* 4.* 5"),
        ({"start": -1}, "start.* 0 .* 4.* -1"),
        ({"stop": 0}, "stop.*start 0.* 0"),
        ({"start": 3, "stop": 3}, "stop.*start 3.* 3"),
        ({"stride": 0}, "stride.* 1.* 0"),
        ({"scale": 0.0}, r"`scale`.* 0(\.0)?$"),
        ({"scale": 2.0}, r"`scale`.* 2(\.0)?$"),
        ({"depth_scale": 0.0}, "depth scale.* 0"),
        ({"depth_scale": 1e-320}, "depth scale.* 1e-320|9.99"),
        ({"masks": "/nowhere/at/all"}, "/nowhere/at/all"),
        ({"on_bad_frame": "ignore"}, "`on_bad_frame`.*error.*skip"),
    ],
)
def test_impossible_options(make: Make, options: dict[str, object], message: str) -> None:
    with pytest.raises(SequenceError, match=message):
        open_sequence(make("replica"), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["x" * 300, "~nobody-of-that-name/room", "room\0"])
def test_impossible_names(name: str) -> None:
    with pytest.raises(SequenceError, match="no such folder or file|too long for a path|zero byte"):
        open_sequence(name)


@pytest.mark.parametrize("place", ["ros2://camera/color,camera/depth", "realsense:", "python:module:make"])
def test_live_cameras_are_named(place: str) -> None:
    with pytest.raises(SequenceError, match="is a live camera.*--record FOLDER"):
        open_sequence(place)


def test_short_trajectory(make: Make) -> None:
    folder = make("replica")
    lines = (folder / "traj.txt").read_text().splitlines()
    (folder / "traj.txt").write_text("\n".join(lines[:3]))
    short = open_sequence(folder)
    assert short.ground_truth is not None and np.isnan(short.ground_truth[:, 0, 0]).tolist() == [False] * 3 + [True] * 2
    assert re.search(r"traj\.txt: .*\b3 poses.*\b5 frames", short.warnings[0])
    (folder / "traj.txt").write_text("\n".join([*lines[:2], "1 2 3", *lines[3:]]))
    assert re.search(r"traj\.txt, line 3: .*16 or 12.* 3", without_pose_2(folder))
    (folder / "traj.txt").write_text("\n".join([*lines[:2], lines[2].replace(lines[2].split()[3], "nan"), *lines[3:]]))
    assert "traj.txt, line 3: pose holds NaN" in without_pose_2(folder)
    (folder / "traj.txt").write_bytes(b"\xff\xfe\x00")
    broken = open_sequence(folder)
    assert broken.ground_truth is None and "traj.txt: cannot be read as text" in broken.pose_problem


def test_wrong_aspect(make: Make) -> None:
    folder = make("folder")
    for i in range(5):
        assert cv2.imwrite(str(folder / "depth" / f"{i}.png"), np.ones((20, 32), np.uint16))
    with pytest.raises(SequenceError, match=r"0\.png.*32x20.*0\.png.*32x24"):
        open_sequence(folder)


def test_tum_bad_lists(make: Make) -> None:
    folder = make("tum")
    (folder / "rgb.txt").write_text("# nothing\n")
    with pytest.raises(SequenceError, match=r"rgb\.txt: .*no images"):
        open_sequence(folder)
    (folder / "rgb.txt").write_text("1000.0 rgb/a.png\nbroken\n")
    with pytest.raises(SequenceError, match=r"rgb\.txt, line 2: .*'broken'"):
        open_sequence(folder)


def test_tum_nan_pose_and_foreign_times(make: Make) -> None:
    folder = make("tum")
    truth = folder / "groundtruth.txt"
    lines = truth.read_text().splitlines()
    truth.write_text("\n".join([*lines[:3], "1000.04 nan 0 0 0 0 0 1", *lines[4:]]))
    [told] = open_sequence(folder).warnings[-1:]
    assert "groundtruth.txt, line 4: pose holds NaN" in told
    truth.write_text("5.0 0 0 0 0 0 0 1\n")
    foreign = open_sequence(folder)
    assert foreign.ground_truth is None and len(list(foreign)) == len(foreign)
    assert "no pose within 0.02 s of any image; poses span 5.000" in foreign.pose_problem
    assert foreign.warnings[-1] == f"no true poses: {foreign.pose_problem}"
    assert open_sequence(folder, truth=False).pose_problem == ""


def test_seven_scenes_bad_pose(make: Make) -> None:
    folder = make("7scenes")
    path = folder / "frame-000002.pose.txt"
    path.write_text("1 0 0 0\n0 1 0 nan\n0 0 1 0\n0 0 0 1\n")
    assert "frame-000002.pose.txt: pose holds NaN" in without_pose_2(folder)
    path.write_text("2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    assert "frame-000002.pose.txt: pose is not a rigid transform" in without_pose_2(folder)
    path.write_text("1 0 0\n")
    assert "frame-000002.pose.txt: expected a 4x4 matrix, found 3 numbers" in without_pose_2(folder)


def without_pose_2(folder: Path) -> str:
    """The warning of a recording of five frames of which the third alone has no true pose."""
    sequence = open_sequence(folder)
    assert sequence.ground_truth is not None
    assert np.isnan(sequence.ground_truth).any((1, 2)).tolist() == [False, False, True, False, False]
    assert len(list(sequence)) == 5
    assert "1 of 5 frames has no true pose; scores are over the other 4" in sequence.warnings[-1]
    return sequence.warnings[-1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("width: 32\n", "'height'"),
        ("[", "not YAML"),
        ("", "width"),
        ("width: 32\nheight: 24\nfx: wide\nfy: 3\ncx: 1\ncy: 1\n", "'fx'.*'wide'"),
        (f"width: {'9' * 400}\nheight: 24\nfx: 3\nfy: 3\ncx: 1\ncy: 1\n", "'width'"),
        ("width: 32\nheight: 24\nfx: -3\nfy: 3\ncx: 1\ncy: 1\n", "-3"),
        ("width: 32\nheight: 24\nfx: 3\nfy: 3\ncx: 1e7\ncy: 1\n", "1e.07, 1 "),
        ("width: 32\nheight: 24\nfx: 3\nfy: 3\ncx: 1\ncy: 1\n", "'depth_scale'"),
        ("width: 32\nheight: 24\nfx: 3\nfy: 3\ncx: 1\ncy: 1\ndepth_scale: 1\ndistortion: [1]\n", "'distortion'"),
    ],
)
def test_folder_bad_settings(make: Make, text: str, message: str) -> None:
    folder = make("folder")
    (folder / "camera.yaml").write_text(text)
    with pytest.raises(SequenceError, match=rf"camera\.yaml: .*{message}"):
        open_sequence(folder)


def test_folder_pose_count(make: Make) -> None:
    folder = make("folder")
    (folder / "poses.txt").write_text("0.5 0 0 0 0 0 0 1\n")
    sequence = open_sequence(folder)
    assert sequence.ground_truth is None and "poses.txt: expected 5 poses, one a frame, found 1" in sequence.warnings[0]


def test_icl_nuim_numbers_beyond_counting(tmp_path: Path) -> None:
    path = make_icl_nuim(tmp_path) / "associations.txt"
    first = path.read_text().splitlines()[0].split()
    path.write_text(" ".join([first[0], first[1], "inf", *first[3:]]) + "\n")
    with pytest.raises(SequenceError, match=r"associations\.txt, line 1: "):
        open_sequence(path.parent)


def test_names_that_no_file_can_have(tmp_path: Path) -> None:
    path = make_nerfcapture(tmp_path) / "transforms.json"
    content = json.loads(path.read_text())
    content["frames"][0]["file_path"] = "images/" + "9" * 300
    path.write_text(json.dumps(content))
    with pytest.raises(SequenceError, match="9999.*: .*too long"):
        open_sequence(path.parent)


def test_replica_bad_parameters(make: Make) -> None:
    folder = make("replica")
    (folder / "cam_params.json").write_text('{"camera": {"w": 32}}')
    with pytest.raises(SequenceError, match=r"cam_params\.json, camera: .*'h'.*`camera`"):
        open_sequence(folder)


def test_masks_that_belong_to_nothing(make: Make, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    assert cv2.imwrite(str(masks / "900.png"), np.zeros((24, 32), np.uint8))
    with pytest.raises(SequenceError, match=r"frame000000\.jpg.*900\.png"):
        open_sequence(make("replica"), masks=masks)


def test_numbers_in_names_may_be_of_any_length() -> None:
    names = ["f10.png", "f" + "9" * 5000 + ".png", "f2.png", "f02.png", "a²b.png", "²"]
    assert sorted(names, key=natural_key)[2:5] == ["f2.png", "f02.png", "f10.png"]
    assert last_number("f" + "9" * 5000) is None and last_number("frame-000012.color") == 12
