# SPDX-License-Identifier: Apache-2.0
"""Intrinsics and depth scale that a user gives hold for every format and command, and a report says whose they are."""

from __future__ import annotations

import dataclasses
import inspect as signatures
import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import ggslam, refuse
from format_makers import MORE_MAKERS
from test_all_formats import MORE_OPTIONS
from tiny_recordings import MAKERS, make_tum, pose

from ggslam.errors import SequenceError
from ggslam.runs.recordings import SequenceRequest, describe, request_in
from ggslam.scene.camera import Camera
from ggslam.sequences import open_sequence


@pytest.mark.parametrize("name", [*MAKERS, *MORE_MAKERS])
def test_every_format(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    place = {**MAKERS, **MORE_MAKERS}[name](tmp_path / name)
    options = MORE_OPTIONS.get(name, {})
    before = open_sequence(place, **options)
    width, height = before.color_size
    text = f"{0.9 * width} {0.8 * width} {0.4 * width} {0.6 * height}"
    sequence = open_sequence(place, intrinsics=text, depth_scale=before.depth_scale / 2, **options)
    expected = Camera(width, height, 0.9 * width, 0.8 * width, 0.4 * width, 0.6 * height)
    if name != "scannet":  # its depth has intrinsics of its own, which colour is brought to
        assert sequence.camera == expected.resize(sequence.camera.width, sequence.camera.height)
    assert (sequence.lens, sequence.camera_source) == ("", "`intrinsics`")
    frame = sequence.frame(2)
    assert frame.depth[frame.camera.height // 2, frame.camera.width // 2] == pytest.approx(2.4, abs=1e-3)
    path = tmp_path / "own.yaml"
    path.write_text(f"width: {width}\nheight: {height}\nfx: 30\nfy: 31\ncx: 15\ncy: 11\ndepth_scale: 500\n")
    again = open_sequence(place, camera=path, depth_scale=None, **options)
    assert again.depth_scale == 500 and again.camera_source == f"`camera` {path}"
    assert open_sequence(place, camera=path, depth_scale=700, **options).depth_scale == 700


def test_distortion_is_undone(make: Callable[[str], Path]) -> None:
    sequence = open_sequence(make("replica"), intrinsics="30, 31, 15, 11, 0.2")
    assert sequence.lens == "4 distortion coefficients undone"
    assert open_sequence(sequence.path, intrinsics="30 31 15 11 .1 0 0 0 .1").lens.startswith("5 ")
    assert open_sequence(sequence.path, intrinsics="30 31 15 11 .1 0 0 0 .1 .1").lens.startswith("8 ")


IMPOSSIBLE = ("", "1 2 3", "30 31 15 eleven", "30 31 15 nan", "-30 31 15 11", "0.75 1 0.5 0.5", "30 9e5 15 11")


@pytest.mark.parametrize("text", [*IMPOSSIBLE, "1 " * 13])
def test_impossible_intrinsics(make: Callable[[str], Path], text: str) -> None:
    with pytest.raises(SequenceError, match="`intrinsics`"):
        open_sequence(make("replica"), intrinsics=text)


def test_both_or_a_file_that_is_none(make: Callable[[str], Path], tmp_path: Path) -> None:
    folder = make("replica")
    with pytest.raises(SequenceError, match="`camera` and `intrinsics`"):
        open_sequence(folder, intrinsics="30 31 15 11", camera=tmp_path / "a.yaml")
    with pytest.raises(SequenceError, match=r"a\.yaml: .*missing"):
        open_sequence(folder, camera=tmp_path / "a.yaml")
    (tmp_path / "a.yaml").write_text("width: 640\nheight: 200\nfx: 300\nfy: 310\ncx: 15\ncy: 11\n")
    with pytest.raises(SequenceError, match="32x24.*640x200"):
        open_sequence(folder, camera=tmp_path / "a.yaml")


@pytest.mark.parametrize("numbers", ["fx: 0.75\nfy: 1\ncx: 0.5\ncy: 0.5", "fx: 30000\nfy: 30000\ncx: 15\ncy: 11"])
def test_focal_lengths_in_other_units_than_pixels(make: Callable[[str], Path], tmp_path: Path, numbers: str) -> None:
    """Of the image's width, or in micrometres; in camera.yaml, in a file with the image's size, and without it."""
    folder = make("folder")
    own = folder / "camera.yaml"
    kept = own.read_text()
    told = (tmp_path / "own.yaml", f"width: 32\nheight: 24\n{numbers}\n"), (tmp_path / "K.yaml", f"{numbers}\n")
    for path, text in told:
        path.write_text(text)
        with pytest.raises(SequenceError, match=rf"{path.name}: .*focal.*32x24"):
            open_sequence(folder, camera=path)
        refuse(ggslam("inspect", folder, "--camera", path), path.name, "impossible focal lengths")
    own.write_text(f"{told[0][1]}depth_scale: 1000\n")
    with pytest.raises(SequenceError, match=r"camera\.yaml: .*focal"):
        open_sequence(folder)
    own.write_text(kept)
    assert open_sequence(folder).camera.width == 32


def test_intrinsics_need_no_file_of_the_recording(make: Callable[[str], Path]) -> None:
    folder = make("folder")
    (folder / "camera.yaml").unlink()
    sequence = open_sequence(folder, format="folder", intrinsics="30 31 15 11", depth_scale=5000)
    assert sequence.camera == Camera(32, 24, 30, 31, 15, 11)
    with pytest.raises(SequenceError, match=r"camera\.yaml.*`depth_scale`"):
        open_sequence(folder, format="folder", intrinsics="30 31 15 11")
    scans = make("scannet")
    (scans / "frames" / "intrinsic" / "intrinsic_color.txt").unlink()
    assert open_sequence(scans, intrinsics="60 60 31 24").warnings == [
        "pose/*.txt: 1 of 5 frames has no true pose; scores are over the other 4"
    ]


def test_a_link_keeps_the_meaning_of_its_name(tmp_path: Path) -> None:
    """Of a link by a speaking name, of a link to one, of two that contradict each other, and of none."""
    plain, speaking = make_tum(tmp_path / "walk"), tmp_path / "rgbd_dataset_freiburg2_xyz"
    for link, target, fx, source in (
        ("my_fr1_desk", plain, 517.3, "freiburg1, by the name 'my_fr1_desk'"),
        ("again", speaking, 520.9, "freiburg2, by the name 'rgbd_dataset_freiburg2_xyz'"),
        ("also_fr3", speaking, 535.4, "freiburg3, by the name 'also_fr3' (the folder"),
    ):
        if not target.exists():
            make_tum(target)
        (tmp_path / link).symlink_to(target)
        sequence = open_sequence(tmp_path / link)
        assert sequence.native_camera.fx == pytest.approx(fx * 32 / 640) and sequence.camera_source.startswith(source)
        told = [text for text in sequence.warnings if "intrinsics are of freiburg3" in text]
        assert len(told) == (link == "also_fr3")
    (tmp_path / "other").symlink_to(plain)
    sequence = open_sequence(tmp_path / "other")
    assert "name 'other', a link to 'walk', does not say freiburg1, 2 or 3" in sequence.warnings[0]
    assert open_sequence(tmp_path / "other", intrinsics="30 31 15 11").warnings == []


def test_raw_seven_scenes_with_a_depth_camera(make: Callable[[str], Path], tmp_path: Path) -> None:
    """Intrinsics of the depth camera are not taken for those of colour, whatever file they stand in."""
    folder = make("7scenes")
    (folder / "camera-intrinsics.color.txt").unlink()
    calibration = tmp_path / "depth.yaml"
    T = "T_color_depth: [1, 0, 0, -0.025, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    calibration.write_text("width: 640\nheight: 480\nfx: 585\nfy: 585\ncx: 320\ncy: 240\n" + T)
    for name, fx, expected in (
        (None, 0, 525.0), ("camera-intrinsics.txt", 585, 525.0), ("camera-intrinsics.depth.txt", 570, 525.0),
        ("camera-intrinsics.txt", 533, 533.0), ("camera-intrinsics.color.txt", 585, 585.0),
    ):  # fmt: skip
        if name:
            (folder / name).write_text(f"{fx} 0 320\n0 {fx} 240\n0 0 1\n")
        sequence = open_sequence(folder, depth_camera=calibration)
        assert sequence._geometry._common.fx == expected, name
        assert sequence.camera_source == ("published, of colour" if expected == 525 else name)
        if name:
            (folder / name).unlink()
    assert sequence.warnings == []
    plain = open_sequence(folder)
    assert plain.camera.fx == 585 and "(`depth_camera` registers it)" in plain.warnings[0]
    own = open_sequence(folder, depth_camera=calibration, intrinsics="530 531 321 241")
    assert own._geometry._common.fx == 530 and own.warnings == []


@pytest.mark.parametrize("command", ["run", "inspect", "volumes", "localize", "submaps"])
def test_every_command_that_reads_recordings_takes_them(command: str) -> None:
    function = getattr(import_module(f"ggslam.cli.{command}_command"), command)
    assert {"camera", "intrinsics", "depth_scale"} <= signatures.signature(function).parameters.keys()


def test_on_the_command_line(make: Callable[[str], Path]) -> None:
    folder = make("replica")
    told = ggslam("inspect", folder, "--intrinsics", "33 34 15 11").stdout
    assert "fx 33.00 fy 34.00" in told and "(--intrinsics)" in told
    wrong = ggslam("inspect", folder, "--intrinsics", "33 34 15")
    assert "--intrinsics: expected 4 numbers 'fx fy cx cy'" in wrong.stderr and wrong.returncode == 2


def test_runs_remember_them(make: Callable[[str], Path], tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text("width: 32\nheight: 24\nfx: 30\nfy: 31\ncx: 15\ncy: 11\n")
    for request in (
        SequenceRequest(make("replica"), camera=path), SequenceRequest(tmp_path / "replica", intrinsics="30 31 15 11"),
    ):  # fmt: skip
        record = describe(request, request.open())
        again = request_in(type(record.open)(**json.loads(record.open.model_dump_json())))
        assert again == dataclasses.replace(request, scale=1.0)


def test_pictures_are_those_of_the_camera_that_is_given(make: Callable[[str], Path]) -> None:
    """A point keeps its pixel, and its place in space follows the intrinsics."""
    folder = make("replica")
    depth = np.full((24, 32), 2000, np.uint16)
    assert cv2.imwrite(str(folder / "results" / "depth000000.png"), depth)
    frame = open_sequence(folder, intrinsics="20 20 10 12").frame(0)
    assert frame.T_world_camera is not None and np.allclose(frame.T_world_camera, pose(0))
    np.testing.assert_allclose(frame.camera.back_project(frame.depth)[22, 30], (2.0, 1.0, 2.0))
