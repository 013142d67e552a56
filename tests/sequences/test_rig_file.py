# SPDX-License-Identifier: Apache-2.0
"""rig.yaml: what is read, and what is refused in one line."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tiny_recordings import MAKERS, pose

from ggslam.errors import SequenceError
from ggslam.sequences import open_sequence, recognise_format
from ggslam.sequences.rig import RigSequence, by_instant
from ggslam.sequences.rig_inspection import inspect_rig
from ggslam.sequences.rig_times import find_instants

TUM = "tum/rgbd_dataset_freiburg3_test"
SIDE = np.array([[0.0, 0, 1, 0.1], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])


def write_rig(folder: Path, *entries: dict[str, Any], **more: Any) -> Path:
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump({"cameras": list(entries), **more}))
    return path


def entry(name: str, recording: str, T: np.ndarray = SIDE, **more: Any) -> dict[str, Any]:
    return {"name": name, "recording": recording, "T_rig_camera": np.asarray(T).reshape(-1).tolist(), **more}


@pytest.fixture
def two(tmp_path: Path) -> Path:
    """A folder with two recordings of five frames, of different formats: TUM and the plain layout; the latter twice."""
    for name in ("tum", "folder"):
        (tmp_path / name).mkdir()
        MAKERS[name](tmp_path / name)
    shutil.copytree(tmp_path / "folder", tmp_path / "again")
    return tmp_path


def open_rig(path: Path, **options: Any) -> RigSequence:
    sequence = open_sequence(path, **options)
    assert isinstance(sequence, RigSequence)
    return sequence


def test_a_rig_in_a_rig_is_refused_also_itself(two: Path) -> None:
    path = write_rig(two, entry("a", TUM), entry("b", "rig.yaml"))
    with pytest.raises(SequenceError) as refused:
        open_sequence(path)
    assert str(refused.value) == f"{path}: camera 'b': {path} is a rig itself"


def test_instants_pair_the_nearest_and_keep_the_others() -> None:
    first, second, third = np.array([0.0, 0.1, 0.2, 0.3]), np.array([0.115, 0.195, 0.25, 0.4]), np.array([0.405, 0.0])
    rows = find_instants([first, second, third], 0.02)
    assert rows.tolist() == [[0, -1, 1], [1, 0, -1], [2, 1, -1], [-1, 2, -1], [3, -1, -1], [-1, 3, 0]]


def test_frames_come_instant_by_instant(two: Path) -> None:
    offset = open_sequence(two / TUM).timestamps[0] - open_sequence(two / "folder").timestamps[0]
    path = write_rig(two, entry("a", TUM, np.eye(4)), entry("b", "folder", time_offset=float(offset)), tolerance=0.03)
    rig = open_rig(path)
    assert recognise_format(path) == recognise_format(two) == "rig" == rig.format
    assert rig.rig.names == ("a", "b")
    np.testing.assert_allclose(rig.rig.T_first_camera, [np.eye(4), SIDE])
    frames = list(rig)
    assert [f.index for f in frames] == list(range(len(rig))) == list(range(10))
    for together in by_instant(frames):
        assert len({f.instant for f in together}) == 1
        times = [f.timestamp for f in together]
        assert max(times) - min(times) <= 0.03
        assert [f.camera_number for f in together] == sorted({f.camera_number for f in together})
    own = open_sequence(two / "folder")
    of_b = [frame for frame in frames if frame.camera_number == 1]
    for frame, expected in zip(of_b, own, strict=True):
        assert frame.source_index == expected.source_index
        np.testing.assert_array_equal(frame.color, expected.color)
        assert frame.timestamp == pytest.approx(expected.timestamp + offset)


def test_instants_are_chosen_as_frames_are(two: Path) -> None:
    path = write_rig(two, entry("a", "folder", np.eye(4)), entry("b", "again"))
    rig = open_rig(path, start=1, stop=5, stride=2)
    assert [f.source_index for f in rig] == [1, 1, 3, 3]
    assert rig.selection == range(1, 5, 2)
    with pytest.raises(SequenceError, match="start.* 0 .* 4.* 5"):
        open_rig(path, start=5)


def test_true_poses_of_another_world_give_way(two: Path) -> None:
    """The second recording's poses are as if its camera lay in the first one: those of the first hold for both."""
    rig = open_rig(write_rig(two, entry("a", "folder", np.eye(4)), entry("b", "again", SIDE)))
    assert rig.ground_truth is not None
    np.testing.assert_allclose(rig.ground_truth[0], pose(0), atol=1e-6)
    np.testing.assert_allclose(rig.ground_truth[1], pose(0) @ SIDE, atol=1e-6)
    report = inspect_rig(rig, samples=2)
    assert (report.instants, report.whole) == (5, 5)
    assert report.cameras[1].off is not None and report.cameras[1].off[1] == pytest.approx(90, abs=0.1)
    assert any("true poses have it 10.0 cm and 90.0 degrees" in warning for warning in report.warnings)


def test_other_processes_read_it_too(two: Path) -> None:
    rig = open_rig(write_rig(two, entry("a", "folder", np.eye(4)), entry("b", "again")))
    again = pickle.loads(pickle.dumps(rig))
    assert len(again) == len(rig) == 10
    for k in (0, 7):
        np.testing.assert_array_equal(again[k].depth, rig[k].depth)
        assert (again[k].instant, again[k].camera_number) == (rig[k].instant, rig[k].camera_number)


def test_damaged_images_and_masks_are_told_by_the_rigs_numbers(two: Path) -> None:
    for name in ("a", "b"):
        shutil.copytree(two / "folder", two / name)
    (two / "b" / "depth" / "2.png").write_bytes(b"nothing")
    (two / "b" / "masks" / "3.png").write_bytes(b"nothing")
    path = write_rig(two, entry("a", "a", np.eye(4)), entry("b", "b"))
    rig = open_rig(path, on_bad_frame="skip")
    assert len(list(rig)) == 9
    assert [(skipped.index, skipped.source_index) for skipped in rig.skipped_frames] == [(5, 2)]
    assert "b: " in rig.skipped_frames[0].reason
    assert list(rig.mask_problems) == [7]
    with pytest.raises(SequenceError, match="2.png"):
        list(open_rig(path))


def test_a_file_without_cameras_says_so(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("camera: []\n")
    with pytest.raises(SequenceError, match=r"rig\.yaml: .*'cameras'"):
        open_sequence(tmp_path / "rig.yaml")


def test_a_camera_has_its_own_scale_and_intrinsics(two: Path) -> None:
    more = {"scale": 0.5, "intrinsics": [30, 30, 15.5, 11.5]}
    rig = open_rig(write_rig(two, entry("a", "folder", np.eye(4)), entry("b", "again", **more)))
    sizes = [(camera.width, camera.height) for camera in rig.rig.cameras]
    assert sizes == [(32, 24), (16, 12)]
    assert rig.rig.cameras[1].fx == 15
    assert [frame.color.shape[:2] for frame in rig][:2] == [(24, 32), (12, 16)]


BAD: dict[str, tuple[list[dict[str, Any]], dict[str, Any], str]] = {
    "one camera": ([entry("a", TUM)], {}, "two cameras.*'a'"),
    "one recording": ([entry("a", TUM), entry("b", TUM)], {}, "'a' and 'b'.*one recording"),
    "twice": ([entry("a", TUM), entry("a", "folder")], {}, "'a'.*twice"),
    "no recording": ([entry("a", TUM), entry("b", "nowhere")], {}, "'b': .*nowhere"),
    "long name": ([entry("a", TUM), entry("b", "x" * 300)], {}, "'b': 'x+...'.*300"),
    "no home": ([entry("a", TUM), entry("b", "~nobody-of-that-name/x")], {}, "'b'.*~nobody-of-that-name"),
    "unknown entry": ([entry("a", TUM), entry("b", "folder", T_rig_camra=1)], {}, "T_rig_camra.*'T_rig_camera'"),
    "unknown name": ([entry("a", TUM), entry("b", "folder")], {"tollerance": 1}, "tollerance.*'tolerance'"),
    "not rigid": ([entry("a", TUM), entry("b", "folder", 2 * np.eye(4))], {}, "'b': expected.*'T_rig_camera'"),
    "no transform": ([entry("a", TUM), {"name": "b", "recording": "folder"}], {}, "'T_rig_camera'.*missing"),
    "no name": ([entry("a", TUM), {**entry("b", "folder"), "name": "a/b"}], {}, "'name'"),
    "no list": ([entry("a", TUM), {**entry("b", "folder"), "topics": "x"}], {}, "'topics'"),
    "tolerance": ([entry("a", TUM), entry("b", "folder")], {"tolerance": 0}, "'tolerance'.* 0"),
    "scale": ([entry("a", TUM), entry("b", "folder", scale=2)], {}, "'scale'.*0.001.* 1"),
    "apart": (
        [entry("a", TUM), entry("b", "folder", time_offset=5)], {}, "'a'.*0.02 s"
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_bad_rigs_are_refused_in_one_line(two: Path, what: str) -> None:
    entries, more, words = BAD[what]
    with pytest.raises(SequenceError, match=words) as caught:
        open_sequence(write_rig(two, *entries, **more))
    assert "\n" not in str(caught.value)
    assert "rig.yaml" in str(caught.value)


def test_what_is_given_twice_is_refused(two: Path) -> None:
    text = write_rig(two, entry("a", TUM), entry("b", "folder")).read_text()
    (two / "rig.yaml").write_text(text.replace(f"  recording: {TUM}", f"  recording: {TUM}\n  recording: folder"))
    with pytest.raises(SequenceError, match=r"line \d+: .*'recording'"):
        open_sequence(two)


def test_a_rig_of_rigs_is_refused(two: Path) -> None:
    write_rig(two, entry("a", TUM), entry("b", "folder", time_offset=0.0), tolerance=10)
    outer = two / "outer.yaml"
    outer.write_text(yaml.safe_dump({"cameras": [entry("c", TUM), entry("d", "rig.yaml")]}))
    with pytest.raises(SequenceError, match="camera 'd': .*"):
        open_sequence(outer)


def test_what_holds_for_one_camera_is_said_in_the_file(two: Path) -> None:
    path = write_rig(two, entry("a", "folder"), entry("b", "again"))
    with pytest.raises(SequenceError, match="`depth_scale`"):
        open_sequence(path, depth_scale=1000)
    with pytest.raises(SequenceError, match=r"rig\.yaml"):
        open_sequence(two / TUM, format="rig")
