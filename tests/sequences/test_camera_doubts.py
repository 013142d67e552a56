# SPDX-License-Identifier: Apache-2.0
"""Intrinsics that cannot be those of the images name sizes and calibration; odd ones are doubted; true ones are not."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
from command_line import ggslam, refuse

from ggslam.scene.camera import Camera
from ggslam.sequences import inspect_sequence, open_sequence
from ggslam.sequences.camera_doubts import doubt_centre, judge_intrinsics

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


@pytest.mark.parametrize(
    ("camera", "severity", "words"),
    [
        (Camera(640, 480, 525, 525, 700, 239.5), "wrong", "700.0, 239.5 lies outside of the images of 640x480"),
        (Camera(640, 480, 525, 525, 639.6, 479.6), "wrong", "the middle of images of 1280x960, not of 640x480"),
        (Camera(640, 480, 525, 525, 159.5, 119.5), "doubtful", "the middle of images of 320x240, not of 640x480"),
        (Camera(480, 640, 525, 525, 319.5, 239.5), "doubtful", "turned by 90 degrees: the principal point 319.5"),
        (Camera(120, 160, 120, 120, 79.5, 59.5), "doubtful", "the middle of 160x120, and the images are 120x160"),
        (Camera(540, 1280, 525, 525, 640, 270), "wrong", "turned by 90 degrees"),
        (Camera(640, 480, 525, 525, 519.5, 239.5), "doubtful", "31% of the image away from its middle"),
        (Camera(640, 480, 1900, 1900, 319.5, 239.5), "doubtful", "angle of view 19 degrees"),
        (Camera(640, 480, 140, 140, 319.5, 239.5), "doubtful", "angle of view 133 degrees"),
        (Camera(640, 480, 525, 700, 319.5, 239.5), "doubtful", "mean pixels 1.33 times as wide as high"),
    ],
)  # fmt: skip
def test_what_is_odd_is_told(camera: Camera, severity: str, words: str) -> None:
    (found,) = judge_intrinsics(camera, source="camera.yaml")
    assert (found.code, found.severity) == ("intrinsics", severity)
    assert words in found.text and found.text.startswith("intrinsics (camera.yaml) ")


@pytest.mark.parametrize(
    "camera",
    [CAMERA, CAMERA.resize(160, 120), Camera(256, 192, 212, 212, 127, 95), Camera(1242, 375, 718.9, 718.9, 607, 185),
     Camera(640, 480, 300, 300, 300, 260), Camera(480, 640, 525, 525, 239.5, 319.5),
     Camera(500, 490, 500, 500, 245, 250),
     Camera(360, 540, 430, 430, 180, 270)],
)  # fmt: skip
def test_usual_cameras_are_not_doubted(camera: Camera) -> None:
    assert judge_intrinsics(camera) == []


def test_a_principal_point_of_a_crop_is_to_be_checked() -> None:
    assert "cx 79.5 and cy 59.5" in (text := doubt_centre(Camera(120, 90, 120, 120, 79.5, 59.5)))
    assert text.endswith("the middle of 120x90 is 59.5, 44.5")
    for camera in (CAMERA, Camera(1242, 375, 718.9, 718.9, 607, 173), Camera(640, 480, 585, 585, 328.9, 253.7)):
        assert doubt_centre(camera) == ""


def written(room: Path, folder: Path, change: Callable[[dict[str, float]], dict[str, float]]) -> Path:
    """The room with other numbers in its camera.yaml."""
    folder.mkdir()
    for name in ("rgb", "depth"):
        (folder / name).symlink_to(room / name)
    lines = dict(line.split(": ", 1) for line in (room / "camera.yaml").read_text().splitlines() if ": " in line)
    names = ("width", "height", "fx", "fy", "cx", "cy")
    numbers = {**{name: float(lines[name]) for name in names}, "depth_scale": float(lines["depth_scale"])}
    text = "".join(f"{name}: {value:g}\n" for name, value in {**numbers, **change(numbers)}.items())
    (folder / "camera.yaml").write_text(text)
    return folder


def test_a_size_that_is_not_that_of_the_numbers_is_told(room: Path, tmp_path: Path) -> None:
    """Calibrated at 160x120, and written down as of 320x240."""
    folder = written(room, tmp_path / "double", lambda c: {"width": 2 * c["width"], "height": 2 * c["height"]})
    (text,) = [v.text for v in inspect_sequence(open_sequence(folder)).verdicts if v.code == "intrinsics"]
    assert "(camera.yaml)" in text and "of 160x120, not of 320x240" in text and "the images are 160x120" in text


def test_an_impossible_principal_point_is_refused(room: Path, tmp_path: Path) -> None:
    folder, fast = written(room, tmp_path / "out", lambda c: {"cx": 1.5 * c["width"]}), ("--no-eval", "--stop", "4")
    refused = ggslam("run", folder, "--out", tmp_path / "run", *fast)
    refuse(refused, "camera.yaml", "240.0, 59.5 lies outside", "160x120")
    assert not (tmp_path / "run").exists()
    done = ggslam("run", folder, "--out", tmp_path / "run", "--no-check", "--strict", *fast)
    assert done.returncode == 3 and "lies outside" in done.stdout


def test_another_shape_names_the_calibration(room: Path, tmp_path: Path) -> None:
    folder = written(room, tmp_path / "wide", lambda c: {"height": 90})
    refuse(ggslam("inspect", folder), "image is 160x120", "for 160x90 (camera.yaml)")


def test_images_mirrored_together_with_depth_are_told_by_true_poses(room: Path, tmp_path: Path) -> None:
    for name, turn in (("mirrored", 1), ("flipped", 0), ("turned", -1)):
        folder = Path(shutil.copytree(room, tmp_path / name))
        for path in [*(folder / "rgb").iterdir(), *(folder / "depth").iterdir()]:
            assert cv2.imwrite(str(path), cv2.flip(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), turn))
        (found,) = inspect_sequence(open_sequence(folder)).verdicts
        assert (found.code, found.severity) == ("mirrored", "doubtful" if name == "turned" else "wrong")
        assert {"mirrored": "in a mirror", "flipped": "upside down", "turned": "180 degrees"}[name] in found.text
        best, plain = (float(part.split()[-1]) for part in found.text.split("%")[:2])
        assert best < 1 < plain  # per cent of the depth
