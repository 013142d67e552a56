# SPDX-License-Identifier: Apache-2.0
"""What a recording lacks, a user can tell: the option stands for it, and without the option the error names it."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed
from format_makers import MORE_MAKERS, write_bag
from image_bags import LAYOUTS, ImageMessages, depth_mm, picture, write_image_bag
from tiny_recordings import MAKERS

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences import open_sequence


def without(path: Path, *keys: str, inside: Callable[[Any], list[dict[str, Any]]] = lambda content: [content]) -> None:
    """Removes entries of a JSON file."""
    content = json.loads(path.read_text())
    for entries in inside(content):
        for key in keys:
            del entries[key]
    path.write_text(json.dumps(content))


def without_metadata(path: Path, key: str) -> None:
    """Removes an entry of the metadata of a .r3d."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    metadata = json.loads(members["metadata"])
    del metadata[key]
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**members, "metadata": json.dumps(metadata)}.items():
            archive.writestr(name, content)


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def every_frame(content: Any) -> list[dict[str, Any]]:
    return [value for value in content.values() if isinstance(value, dict)]


LACKS: dict[str, list[Callable[[Path], object]]] = {
    "folder": [lambda f: (f / "camera.yaml").unlink(), lambda f: change(f / "camera.yaml", "fx: 30", "fz: 30")],
    "replica": [lambda f: without(f / "cam_params.json", "fx", inside=lambda content: [content["camera"]])],
    "scannet": [lambda f: (f / "frames" / "intrinsic" / "intrinsic_color.txt").unlink()],
    "7scenes": [lambda f: (f / "camera-intrinsics.color.txt").write_text("30 0\n")],
    "nerfstudio": [
        lambda f: without(f / "transforms.json", "fl_x", "cx"),
        lambda f: change(f / "transforms.json", '"OPENCV"', '"EQUIRECTANGULAR"'),
    ],
    "nerfcapture": [lambda f: without(f / "transforms.json", "fl_x", inside=lambda content: content["frames"])],
    "scannet++": [lambda f: without(f / "dslr" / "nerfstudio" / "transforms_undistorted.json", "fl_y")],
    "scannet++ iphone": [lambda f: without(f / "iphone" / "pose_intrinsic_imu.json", "intrinsic", inside=every_frame)],
    "record3d": [lambda path: without_metadata(path, "K")],
    "polycam": [
        lambda f: [without(path, "fx") for path in (f / "keyframes" / "cameras").iterdir()],
        lambda f: (f / "keyframes" / "cameras" / "1004.json").unlink(),
    ],
    "strayscanner": [lambda f: (f / "camera_matrix.csv").unlink()],
    "rtabmap": [
        lambda f: change(f / "calib" / "5.yaml", "camera_matrix", "matrix"),
        lambda f: (f / "calib" / "3.yaml").unlink(),
    ],
    "3dscannerapp": [lambda f: [without(path, "intrinsics") for path in f.glob("frame_*.json")]],
}
"""Of each format that looks for intrinsics somewhere: ways to lack them. The others know them by heart."""
BY_HEART = {"tum", "vmap", "icl-nuim"}


def test_no_format_is_left_out() -> None:
    assert {*MAKERS, *MORE_MAKERS} == {*LACKS, *BY_HEART, "ros1", "ros2"}


@pytest.mark.parametrize(("name", "way"), [(name, way) for name, ways in LACKS.items() for way in range(len(ways))])
def test_intrinsics_that_a_recording_lacks(tmp_path: Path, name: str, way: int) -> None:
    place = {**MAKERS, **MORE_MAKERS}[name](tmp_path)
    whole = open_sequence(place)
    color, wanted = whole.color_size, [np.median(frame.depth) for frame in whole]
    LACKS[name][way](place)
    with pytest.raises(SequenceError, match="`camera` or `intrinsics`"):
        open_sequence(place)
    text, camera = f"61 62 {color[0] / 2} {color[1] / 2}", Camera(*color, 61, 62, color[0] / 2, color[1] / 2)
    file = tmp_path / "own.yaml"
    lines = [f"{key}: {getattr(camera, key)}" for key in ("width", "height", "fx", "fy", "cx", "cy")]
    file.write_text("\n".join(lines))
    scale = whole.depth_scale
    for options in ({"intrinsics": text}, {"camera": file}):
        sequence = open_sequence(place, depth_scale=scale, **options)
        if name != "scannet":  # it is brought to the intrinsics of depth
            assert sequence.native_camera == camera.resize(sequence.native_camera.width, sequence.native_camera.height)
        frames = list(sequence)
        np.testing.assert_allclose([np.median(frame.depth) for frame in frames], wanted, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "remove"),
    [
        ("folder", lambda f: change(f / "camera.yaml", "depth_scale: 5000", "")),
        ("replica", lambda f: without(f / "cam_params.json", "scale", inside=lambda content: [content["camera"]])),
    ],
)
def test_depth_scale_that_a_recording_lacks(
    make: Callable[[str], Path], name: str, remove: Callable[[Path], object]
) -> None:
    folder = make(name)
    scale, depth = open_sequence(folder).depth_scale, open_sequence(folder).frame(1).depth
    remove(folder)
    with pytest.raises(SequenceError, match="scale'.*`depth_scale`"):
        open_sequence(folder)
    assert np.array_equal(open_sequence(folder, depth_scale=scale).frame(1).depth, depth)


def test_depth_camera_that_a_recording_lacks(make: Callable[[str], Path], tmp_path: Path) -> None:
    folder = make("folder")
    with (folder / "camera.yaml").open("a") as file:
        file.write("depth_camera: {width: 32, height: 24}\n")
    with pytest.raises(SequenceError, match="'T_color_depth'.*`depth_camera`"):
        open_sequence(folder)
    own = tmp_path / "depth.yaml"
    T = "T_color_depth: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    own.write_text("width: 32\nheight: 24\nfx: 30\nfy: 31\ncx: 15\ncy: 11\n" + T)
    assert open_sequence(folder, depth_camera=own).frame(2).depth[12, 16] == pytest.approx(1.2, abs=1e-4)


def test_a_folder_of_images_alone_is_recognised(make: Callable[[str], Path]) -> None:
    folder = make("folder")
    (folder / "camera.yaml").unlink()
    refuse(ggslam("inspect", folder), "camera.yaml", "--camera or --intrinsics")
    told = succeed("inspect", folder, "--intrinsics", "30 31 15 11", "--depth-scale", 5000)
    assert "fx 30.00 fy 31.00" in told


def colors(messages: ImageMessages, time: float, i: int) -> Any:
    return messages.raw_image(time, "rgb8", LAYOUTS["rgb8"](picture(i)))


def depths(messages: ImageMessages, time: float, i: int) -> Any:
    return messages.raw_image(time, "16UC1", depth_mm(i))


@pytest.mark.parametrize("storage", ["ros1", "mcap"])
def test_bag_without_camera_info(tmp_path: Path, storage: str) -> None:
    path = write_image_bag(tmp_path, storage, colors, depths, info=False)
    refuse(
        ggslam("inspect", path), "no camera_info belongs to /camera/color/image_raw", "--topic color_info=TOPIC",
        "--camera or --intrinsics",
    )  # fmt: skip
    sequence = open_sequence(path, intrinsics="30 31 15 11")
    assert sequence.camera == Camera(32, 24, 30, 31, 15, 11) and sequence.warnings == []
    for i, frame in enumerate(sequence):
        assert np.array_equal(frame.color, picture(i))
        np.testing.assert_allclose(1000 * frame.depth, depth_mm(i), atol=1e-3)


@pytest.mark.parametrize("ros2", [False, True])
def test_bag_of_a_camera_that_nobody_calibrated(tmp_path: Path, ros2: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drivers write zeros then; the topic may also be empty."""
    true_info = ImageMessages.info

    def zeros(self: Any, *arguments: Any) -> Any:
        info = true_info(self, *arguments)
        for name in ("k", "p") if self.ros2 else ("K", "P"):
            getattr(info, name)[:] = 0
        return info

    monkeypatch.setattr("format_makers.BagMessages.info", zeros)
    path = write_bag(tmp_path / ("walk" if ros2 else "walk.bag"), ros2)
    with pytest.raises(SequenceError, match="color/camera_info: .*`camera` or `intrinsics`"):
        open_sequence(path)
    sequence = open_sequence(path, intrinsics="30 31 15 11")
    assert sequence.camera == Camera(32, 24, 30, 31, 15, 11) and not sequence.registered
    assert sequence.frame(3).depth[12, 16] == pytest.approx(1.3, abs=2e-4)


def test_depth_beside_a_camera_that_a_user_tells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bag's own calibration of depth, and /tf_static, bring depth to the user's colour camera."""
    path = write_bag(tmp_path / "walk.bag", False, registered=False)
    before = open_sequence(path).frame(0).depth
    monkeypatch.setattr("ggslam.sequences.formats.ros_topics.info_above", lambda topic, types: _only_depth(topic))
    sequence = open_sequence(path, intrinsics="30 31 15 11")
    assert sequence.registered and np.array_equal(sequence.frame(0).depth, before)


def _only_depth(topic: str) -> str | None:
    return "/camera/depth/camera_info" if "depth" in topic else None
