# SPDX-License-Identifier: Apache-2.0
"""Recordings of phones, data sets with JSON and ROS: the same frames out of every one; prints the table of loaders."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from format_makers import MORE_MAKERS, confidence, make_record3d, write_bag, write_video
from tiny_recordings import FRAMES, MAKERS, pose, write_depth

from ggslam.errors import SequenceError
from ggslam.sequences import FORMATS, open_sequence, recognise_format

FINER = ("strayscanner", "3dscannerapp")
"""Those with colour four times as fine as depth, which comes out at the size of colour."""
MORE_OPTIONS = {"ros1": {"topics": ["pose=/poses"]}, "ros2": {"topics": ["pose=/poses"]}}


def format_of(name: str) -> str:
    return {"nerfcapture": "nerfstudio", "scannet++ iphone": "scannet++"}.get(name, name)


@pytest.fixture
def make_more(tmp_path: Path) -> Callable[[str], Path]:
    def build(name: str) -> Path:
        folder = tmp_path / f"{name}-recording"
        folder.mkdir()
        return MORE_MAKERS[name](folder)

    return build


@pytest.mark.parametrize("name", MORE_MAKERS)
def test_frames_of_every_format(make_more: Callable[[str], Path], name: str) -> None:
    place = make_more(name)
    assert recognise_format(place) == format_of(name)
    sequence = open_sequence(place, **MORE_OPTIONS.get(name, {}))
    assert (sequence.format, len(sequence)) == (format_of(name), FRAMES)
    size = {"vmap": (60, 34), **dict.fromkeys(FINER, (128, 96))}.get(name, (32, 24))
    row, column = size[1] // 2, size[0] // 2
    assert (sequence.camera.width, sequence.camera.height) == size
    assert (np.diff(sequence.timestamps) > 0).all() and sequence.warnings == []
    for i, frame in enumerate(sequence.stream()):
        assert frame.color.shape == (size[1], size[0], 3) and frame.color.dtype == np.uint8
        assert np.abs(frame.color[row, column].astype(int) - (10 * i, 100, 200)).max() <= 4  # JPEG, video
        assert frame.depth.dtype == np.float32 and frame.depth[0, 0] == 0
        assert frame.depth[row, column] == pytest.approx(1 + i / 10, abs=2e-4)
        assert frame.T_world_camera is not None
        np.testing.assert_allclose(frame.T_world_camera, pose(i), atol=2e-5)
    backwards = [sequence.frame(i).depth[row, column] for i in (4, 0, 3)]
    np.testing.assert_allclose(backwards, (1.4, 1.0, 1.3), atol=2e-4)
    reds = [float(sequence.frame(i).color[row, column, 0]) for i in (3, 0, 4)]
    np.testing.assert_allclose(reds, (30, 0, 40), atol=4)


def test_table_of_loaders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every loader has a maker here (RealSense a file of its own tests); the table is what a reader of the log sees."""
    lines = []
    for name, build in {**MAKERS, **MORE_MAKERS}.items():
        (tmp_path / name).mkdir()
        sequence = open_sequence(build(tmp_path / name))
        c = sequence.camera
        posed = 0 if sequence.ground_truth is None else int(np.isfinite(sequence.ground_truth).all((1, 2)).sum())
        lines.append(
            f"{name:<17} {sequence.format:<13} {len(sequence)} frames {c.width}x{c.height} fx {c.fx:6.1f} "
            f"depth 1/{sequence.depth_scale:<6g} poses {posed} ({sequence.pose_source})"
        )
    with capsys.disabled():
        print("\n" + "\n".join(lines))
    made = {format_of(name) for name in {**MAKERS, **MORE_MAKERS}}
    assert made | {"synthetic", "realsense"} == {f.name for f in FORMATS}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("icl-nuim", (24.06, 24.0)), ("nerfstudio", (30, 31)), ("nerfcapture", (30, 31)), ("scannet++", (30, 31)),
        ("scannet++ iphone", (30, 30)), ("record3d", (30, 31)), ("polycam", (30, 31)), ("strayscanner", (120, 124)),
        ("3dscannerapp", (120, 124)), ("ros1", (30, 31)), ("ros2", (30, 31)),
    ],
)  # fmt: skip
def test_intrinsics(make_more: Callable[[str], Path], name: str, expected: tuple[float, float]) -> None:
    camera = open_sequence(make_more(name)).camera
    assert (camera.fx, camera.fy) == pytest.approx(expected)
    if name not in ("icl-nuim", "scannet++ iphone", "record3d", "polycam", "strayscanner", "3dscannerapp"):
        assert (camera.cx, camera.cy) == (15, 11)


@pytest.mark.parametrize("name", ["record3d", "polycam", "strayscanner", "3dscannerapp"])
def test_confidence(make_more: Callable[[str], Path], name: str) -> None:
    place = make_more(name)
    for least, first_seen in ((None, 1), (0, 0), (1, 1), (2, 2)):
        sequence = open_sequence(place, min_confidence=least)
        assert sequence.min_confidence == (1 if least is None else least)
        finer = 4 if name in FINER else 1
        depth = sequence.frame(1).depth[5 * finer]
        assert np.flatnonzero(depth)[0] == first_seen * finer
    with pytest.raises(SequenceError, match="min_confidence.*0, 1 or 2.*3"):
        open_sequence(place, min_confidence=3)


def test_record3d_of_plain_bytes(tmp_path: Path) -> None:
    pytest.importorskip("liblzfse")
    assert open_sequence(make_record3d(tmp_path, compress=False)).frame(4).depth[5, 5] == pytest.approx(1.4)


def test_intrinsics_that_change_are_made_steady(make_more: Callable[[str], Path]) -> None:
    """A frame with another focal length comes out as if it had been taken with the first one's."""
    folder = make_more("polycam")
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    for number, focal in ((1000, 60.0), (1001, 75.0)):
        picture = np.uint8(127 + 100 * np.sin((u - 31.5) / focal * 12))[..., None].repeat(3, 2)
        assert cv2.imwrite(str(folder / "keyframes" / "images" / f"{number}.jpg"), picture)
        path = folder / "keyframes" / "cameras" / f"{number}.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "fx": focal}))
    sequence = open_sequence(folder)
    first, second = (sequence.frame(i).color[12, 6:26, 0].astype(float) for i in (0, 1))
    assert np.abs(first - second).mean() < 6
    assert sequence.camera.fx == 30


def test_polycam_without_sizes(make_more: Callable[[str], Path]) -> None:
    """Cameras are of the size of the images then."""
    folder = make_more("polycam")
    wanted = open_sequence(folder)
    for path in (folder / "keyframes" / "cameras").iterdir():
        content = json.loads(path.read_text())
        path.write_text(json.dumps({key: value for key, value in content.items() if key not in ("width", "height")}))
    found = open_sequence(folder)
    assert found.native_camera == wanted.native_camera and found.color_size == wanted.color_size
    assert np.array_equal(found.frame(2).depth, wanted.frame(2).depth)


def test_transforms_with_distortion_and_units(make_more: Callable[[str], Path]) -> None:
    folder = make_more("nerfstudio")
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "k1": 0.3, "depth_unit_scale_factor": 0.0002}))
    sequence = open_sequence(folder)
    assert sequence.depth_scale == pytest.approx(5000)
    assert sequence.frame(0).depth[12, 16] == pytest.approx(0.2)
    for model in ("OPENCV_FISHEYE", "PINHOLE"):
        path.write_text(json.dumps({**content, "camera_model": model, "k1": 0.3}))
        assert len(open_sequence(folder)) == FRAMES
    for change, message in (
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"fl_x": -1}, "-1"), ({"frames": 3}, "'frames'"),
        ({"cx": "wide"}, "'cx'"),
    ):  # fmt: skip
        path.write_text(json.dumps({**content, **change}))
        with pytest.raises(SequenceError, match=rf"transforms\.json.*{message}"):
            open_sequence(folder)
    for frame in content["frames"]:
        del frame["depth_file_path"]
    path.write_text(json.dumps(content))
    with pytest.raises(SequenceError, match="depth_file_path or depth_path"):
        open_sequence(folder)


def test_fisheye_is_undone(make_more: Callable[[str], Path]) -> None:
    """A stripe pattern drawn through the fisheye model comes out straight."""
    folder = make_more("nerfstudio")
    width, height, focal = 160, 120, 90.0
    K, coefficients = np.array([[focal, 0, 79.5], [0, focal, 59.5], [0, 0, 1]]), np.array([-0.1, 0.02, 0.0, 0.0])
    v, u = np.mgrid[:height, :width].astype(np.float64)
    straight = cv2.fisheye.undistortPoints(np.stack([u, v], -1).reshape(-1, 1, 2), K, coefficients, P=K)
    stored = np.uint8(127 + 100 * np.sin(straight.reshape(height, width, 2)[..., :1] / 4)).repeat(3, 2)
    assert cv2.imwrite(str(folder / "images" / "0.png"), stored)
    write_depth(folder / "depth" / "0.png", 0, 1000, (width, height))
    content = json.loads((folder / "transforms.json").read_text())
    content |= {"fl_x": focal, "fl_y": focal, "cx": 80.0, "cy": 60.0, "w": width, "h": height}
    content |= {"camera_model": "OPENCV_FISHEYE", "k1": -0.1, "k2": 0.02}
    (folder / "transforms.json").write_text(json.dumps(content))
    color = open_sequence(folder, stop=1).frame(0).color[..., 0].astype(float)
    inner = (slice(20, -20), slice(30, -30))
    wanted = 127 + 100 * np.sin(u / 4)
    assert np.abs(color - wanted)[inner].mean() < 6 < np.abs(stored[..., 0] - wanted)[inner].mean()


def test_video_frames_are_found_by_number(make_more: Callable[[str], Path]) -> None:
    """A depth image that is missing leaves its frame of the video out; intrinsics of each frame are read."""
    folder = make_more("strayscanner")
    (folder / "depth" / "000001.png").unlink()
    lines = (folder / "odometry.csv").read_text().splitlines()
    with_intrinsics = [lines[0] + ", fx, fy, cx, cy", *(line + ", 120, 120, 63.5, 47.5" for line in lines[1:])]
    (folder / "odometry.csv").write_text("\n".join(with_intrinsics))
    sequence = open_sequence(folder)
    assert len(sequence) == FRAMES - 1 and sequence.camera.fy == 120
    assert [round(float(f.color[48, 64, 0]) / 10) for f in sequence.stream()] == [0, 2, 3, 4]
    for path in sorted((folder / "depth").iterdir()):
        np.save(path.with_suffix(".npy"), cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        path.unlink()
    assert open_sequence(folder).frame(1).depth[48, 64] == pytest.approx(1.2)


def test_long_video_in_any_order(tmp_path: Path) -> None:
    from ggslam.sequences.video import Video

    bits = np.arange(8)
    pictures = [np.uint8(255 * (i >> bits & 1)).repeat(8)[None, :, None].repeat(32, 0).repeat(3, 2) for i in range(220)]
    write_video(tmp_path / "long.mp4", pictures)
    video = Video(tmp_path / "long.mp4")
    assert video.count == 220
    for i in (0, 1, 150, 20, 219, 100, 101, 5):
        read = video.frame(i)[16, 4::8, 0] > 127
        assert (read * 2**bits).sum() == i


@pytest.mark.parametrize("ros2", [False, True])
@pytest.mark.parametrize(("compressed", "metres"), [(True, False), (False, True), (True, True)])
def test_kinds_of_ros_images(tmp_path: Path, ros2: bool, compressed: bool, metres: bool) -> None:
    sequence = open_sequence(write_bag(tmp_path / ("walk" if ros2 else "walk.bag"), ros2, compressed, metres))
    assert sequence.depth_scale == (1 if metres else 1000)
    frame = sequence.frame(3)
    assert frame.depth[12, 16] == pytest.approx(1.3, abs=2e-3) and frame.depth[0, 0] == 0
    assert np.abs(frame.color[12, 16].astype(int) - (30, 100, 200)).max() == 0


def test_ros_depth_of_another_camera_is_registered(tmp_path: Path) -> None:
    """Colour stands 5 cm to the right of depth: what depth sees at column u is 30 * 0.05 / z pixels further left."""
    sequence = open_sequence(write_bag(tmp_path / "walk.bag", False, registered=False))
    assert sequence.registered
    row = sequence.frame(0).depth[12]
    assert row[16] == pytest.approx(1.0) and (row[:29] > 0).all() and row[31] == 0
    distorted = open_sequence(write_bag(tmp_path / "fish.bag", False, d=(0.1, 0, 0, 0), model="equidistant"))
    eight = (0.1, 0, 0, 0, 0, 0, 0.1, 0)
    rational = open_sequence(write_bag(tmp_path / "eight.bag", False, d=eight, model="rational_polynomial"))
    assert distorted.frame(0).depth.shape == rational.frame(0).depth.shape == (24, 32)


def test_ros_topics_can_be_given(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "walk.bag", False)
    with pytest.raises(SequenceError, match="/nowhere .*color.*/camera"):
        open_sequence(bag, topics=["color=/nowhere"])
    with pytest.raises(SequenceError, match="ROLE=TOPIC.*color"):
        open_sequence(bag, topics=["sound=/camera/color/image_raw"])
    with pytest.raises(SequenceError, match="16UC1"):
        open_sequence(bag, topics=["color=/camera/aligned_depth_to_color/image_raw"])
    with pytest.raises(SequenceError, match="sensor_msgs/.*Image.*pose"):
        open_sequence(bag, topics=["pose=/camera/color/image_raw"])
    assert open_sequence(bag).ground_truth is None


def test_seven_scenes_registered_by_a_calibration(make: Callable[[str], Path], tmp_path: Path) -> None:
    """A near square in front of a wall moves left by fx t / z, further than the wall, and hides what is behind it."""
    folder = make("7scenes")
    depth = np.full((24, 32), 3000, np.uint16)
    depth[8:16, 14:20] = 1000
    assert cv2.imwrite(str(folder / "frame-000000.depth.png"), depth)
    (folder / "camera-intrinsics.color.txt").unlink()
    lines = "width: 32\nheight: 24\nfx: 30\nfy: 30\ncx: 15.5\ncy: 11.5\n"
    T = "T_color_depth: [1, 0, 0, -0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    color = "color: {width: 32, height: 24, fx: 30, fy: 30, cx: 15.5, cy: 11.5}\n"
    calibration = tmp_path / "depth.yaml"
    calibration.write_text(lines + T + color)
    sequence = open_sequence(folder, depth_camera=calibration)
    assert sequence.warnings == []
    row = sequence.frame(0).depth[12]
    assert np.flatnonzero(np.abs(row - 1) < 1e-3).tolist() == [11, 12, 13, 14, 15, 16]
    np.testing.assert_allclose(row[:11], 3.0)
    assert (row[17:19] == 0).any()  # behind the square: seen by colour, not by depth
    calibration.write_text(lines + color)
    with pytest.raises(SequenceError, match=r"depth\.yaml: .*'T_color_depth'.*missing"):
        open_sequence(folder, depth_camera=calibration)
    calibration.write_text(lines + T.replace("-0.1", "nan"))
    with pytest.raises(SequenceError, match="'T_color_depth'.*16 numbers"):
        open_sequence(folder, depth_camera=calibration)


def test_folder_with_a_depth_camera_of_other_size_and_aspect(make: Callable[[str], Path]) -> None:
    folder = make("folder")
    shutil.rmtree(folder / "masks")
    for i in range(5):
        write_depth(folder / "depth" / f"{i}.png", i, 5000, (24, 24))
    entries = "depth_camera:\n  {width: 24, height: 24, fx: 15, fy: 15, cx: 11.5, cy: 11.5, "
    T = "T_color_depth: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}\n"
    with (folder / "camera.yaml").open("a") as file:
        file.write(entries + T)
    sequence = open_sequence(folder)
    assert (sequence.camera.width, sequence.camera.height) == (16, 12) and sequence.camera.fx == pytest.approx(15)
    depth = sequence.frame(2).depth
    assert depth.shape == (12, 16) and (depth[1:-1, 1:-1] > 0).all() and depth[6, 8] == pytest.approx(1.2)


def test_confidence_of_another_size(make_more: Callable[[str], Path]) -> None:
    folder = make_more("strayscanner")
    assert cv2.imwrite(str(folder / "confidence" / "000002.png"), confidence((16, 12)))
    with pytest.raises(SequenceError, match=r"000002\.png: .*32x24.*16x12"):
        open_sequence(folder).frame(2)
