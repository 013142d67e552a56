# SPDX-License-Identifier: Apache-2.0
"""Every format delivers the same frames: sizes, units, poses, masks, times."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from ggslam.errors import SequenceError
from ggslam.sequences import open_sequence, recognise_format

Make = Callable[[str], Path]
ALL = ("replica", "tum", "7scenes", "scannet", "folder")


def expected_pose(i: int) -> np.ndarray:
    c, s = np.cos(0.1 * i), np.sin(0.1 * i)
    return np.array([[c, -s, 0, 0.1 * i], [s, c, 0, 0.2], [0, 0, 1, -0.3], [0, 0, 0, 1]])


@pytest.mark.parametrize("name", ALL)
def test_frames_of_every_format(make: Make, name: str) -> None:
    folder = make(name)
    assert recognise_format(folder) == name
    sequence = open_sequence(folder)
    assert (sequence.format, len(sequence)) == (name, 5)
    assert (sequence.camera.width, sequence.camera.height) == (32, 24)
    assert sequence.timestamps.shape == (5,) and (np.diff(sequence.timestamps) > 0).all()
    assert sequence.ground_truth is not None and sequence.ground_truth.shape == (5, 4, 4)
    for i, frame in enumerate(sequence.stream()):
        assert (frame.index, frame.source_index, frame.timestamp) == (i, i, sequence.timestamps[i])
        assert frame.color.shape == (24, 32, 3) and frame.color.dtype == np.uint8
        assert np.abs(frame.color[12, 16].astype(int) - (10 * i, 100, 200)).max() <= 3  # JPEG
        assert frame.depth.shape == (24, 32) and frame.depth.dtype == np.float32
        assert frame.depth[0, 0] == 0
        assert frame.depth[12, 16] == pytest.approx(1 + i / 10, abs=1e-4)
        if name == "scannet" and i == 2:
            assert frame.T_world_camera is None and np.isnan(sequence.ground_truth[2]).all()
        else:
            assert frame.T_world_camera is not None
            np.testing.assert_allclose(frame.T_world_camera, expected_pose(i), atol=2e-5)
        if name == "tum":
            assert frame.mask is None and not sequence.has_masks
        else:
            assert sequence.has_masks and frame.mask is not None and frame.mask.dtype == np.uint16
            assert frame.mask[12, 2] == 0 and frame.mask[12, 29] == i + 1


@pytest.mark.parametrize("name", ["replica", "7scenes", "folder"])
def test_intrinsics_are_read_and_scaled(make: Make, name: str) -> None:
    folder = make(name)
    camera = open_sequence(folder).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30, 31, 15, 11)
    half = open_sequence(folder, scale=0.5)
    assert half.camera == camera.scale(0.5)
    frame = half.frame(1)
    assert frame.color.shape == (12, 16, 3) and frame.depth.shape == (12, 16) and frame.mask is not None
    assert frame.mask.shape == (12, 16)


def test_replica_defaults_and_parent_parameters(make: Make, tmp_path: Path) -> None:
    folder = make("replica")
    (folder / "cam_params.json").rename(folder.parent / "cam_params.json")
    assert open_sequence(folder).camera.fx == 30
    (folder.parent / "cam_params.json").unlink()
    with pytest.raises(SequenceError, match="32x24.*1200x680"):
        open_sequence(folder)
    shutil.rmtree(folder / "semantic_instance")
    for i in range(5):
        path = folder / "results" / f"frame{i:06d}.jpg"
        assert cv2.imwrite(str(path), np.zeros((68, 120, 3), np.uint8))
        depth = np.full((68, 120), 6554, np.uint16)
        assert cv2.imwrite(str(folder / "results" / f"depth{i:06d}.png"), depth)
    sequence = open_sequence(folder)
    assert sequence.camera.fx == pytest.approx(60) and sequence.depth_scale == 6553.5
    assert sequence.frame(0).depth[5, 5] == pytest.approx(1.0, abs=1e-3)


def test_ground_truth_is_optional(make: Make) -> None:
    for name, file in (("replica", "traj.txt"), ("tum", "groundtruth.txt"), ("folder", "poses.txt")):
        folder = make(name)
        (folder / file).unlink()
        sequence = open_sequence(folder)
        assert sequence.ground_truth is None and sequence.frame(0).T_world_camera is None


def test_selection(make: Make) -> None:
    sequence = open_sequence(make("replica"), start=1, stop=99, stride=2)
    assert [frame.source_index for frame in sequence.stream()] == [1, 3]
    assert sequence.frame(1).index == 1 and sequence.timestamps[0] == pytest.approx(1 / 30)
    np.testing.assert_allclose(sequence.ground_truth[1], expected_pose(3), atol=1e-6)


SMALLER = 640 / 32
"""Of the images that TUM's published intrinsics are for, against those here: they are brought to their size."""


def test_tum_calibrations_and_distortion(tmp_path: Path, make: Make) -> None:
    source = make("tum")
    assert open_sequence(source).camera.fx == pytest.approx(535.4 / SMALLER)
    first = source.parent / "rgbd_dataset_freiburg1_desk"
    shutil.copytree(source, first)
    sequence = open_sequence(first)
    assert (sequence.camera.fx, sequence.camera.cy) == pytest.approx((517.3 / SMALLER, 255.8 / SMALLER - 0.5))
    other = source.parent / "mine"
    shutil.copytree(source, other)
    sequence = open_sequence(other)
    assert sequence.camera.fx == pytest.approx(525 / SMALLER) and "freiburg1, 2 or 3" in sequence.warnings[0]


def test_distortion_is_undone(make: Make) -> None:
    """A grid drawn through the distortion model comes out straight."""
    folder = make("folder")
    width, height = 160, 120
    K = np.array([[130.0, 0, 79.5], [0, 130.0, 59.5], [0, 0, 1]])
    coefficients = np.array([0.25, -0.2, 0.002, -0.001, 0.05])
    v, u = np.mgrid[:height, :width].astype(np.float32)
    straight = cv2.undistortPoints(np.stack([u, v], -1).reshape(-1, 1, 2), K, coefficients, P=K).reshape(
        height, width, 2
    )
    stored = np.repeat(np.uint8(127 + 120 * np.sin(straight[..., :1] / 4)), 3, 2)
    assert cv2.imwrite(str(folder / "rgb" / "0.png"), stored)
    assert cv2.imwrite(str(folder / "depth" / "0.png"), np.full((height, width), 5000, np.uint16))
    settings = {"width": width, "height": height, "fx": 130, "fy": 130, "cx": 79.5, "cy": 59.5, "depth_scale": 5000}
    (folder / "camera.yaml").write_text(yaml.safe_dump({**settings, "distortion": coefficients.tolist()}))
    shutil.rmtree(folder / "masks")
    color = open_sequence(folder, stop=1).frame(0).color[..., 0].astype(float)
    wanted = 127 + 120 * np.sin(u / 4)
    inner = (slice(20, -20), slice(20, -20))
    assert np.abs(color - wanted)[inner].mean() < 4 < np.abs(stored[..., 0] - wanted)[inner].mean()


def test_tum_association_falls_back(make: Make, tmp_path: Path) -> None:
    folder = make("tum")
    lines = (folder / "depth.txt").read_text().splitlines()
    shifted = [f"{float(line.split()[0]) + 0.05:.6f} {line.split()[1]}" for line in lines[1:]]
    # A depth image is now nearest to a later colour image; only every other colour image keeps its own.
    (folder / "depth.txt").write_text("\n".join(shifted))
    (folder / "rgb.txt").write_text("\n".join((folder / "rgb.txt").read_text().splitlines()[::3]))
    sequence = open_sequence(folder)
    assert len(sequence) >= 1
    far = [f"{float(line.split()[0]) + 7:.6f} {line.split()[1]}" for line in lines[1:]]
    (folder / "depth.txt").write_text("\n".join(far))
    with pytest.raises(SequenceError, match=r"0\.08 s.*6\.\d+ s"):
        open_sequence(folder)


def test_tum_pose_gaps_are_no_poses(make: Make) -> None:
    folder = make("tum")
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join(lines[:4]))
    sequence = open_sequence(folder)
    assert np.isfinite(sequence.ground_truth[:1]).all() and np.isnan(sequence.ground_truth[3:]).all()
    assert "groundtruth.txt: 3 of 5 frames have no true pose; scores are over the other 2" in sequence.warnings[0]


def test_plain_seven_scenes_is_warned_about(make: Make) -> None:
    folder = make("7scenes")
    (folder / "camera-intrinsics.color.txt").unlink()
    sequence = open_sequence(folder)
    assert sequence.camera.fx == 585 and "not registered" in sequence.warnings[0]
    scene = folder.parent / "chess"
    shutil.copytree(folder, scene / "seq-01")
    assert len(open_sequence(scene)) == 5
    shutil.copytree(folder, scene / "seq-02")
    with pytest.raises(SequenceError, match="seq-01, seq-02"):
        open_sequence(scene)


def test_seven_scenes_invalid_depth(make: Make) -> None:
    folder = make("7scenes")
    raw = np.full((24, 32), 65535, np.uint16)
    raw[3, 4] = 1500
    assert cv2.imwrite(str(folder / "frame-000000.depth.png"), raw)
    depth = open_sequence(folder).frame(0).depth
    assert depth[3, 4] == pytest.approx(1.5) and (depth > 0).sum() == 1


def test_scannet_colour_is_brought_onto_depth_pixels(make: Make) -> None:
    folder = make("scannet")
    u = np.arange(64)
    ramp = np.repeat(np.uint8(3 * u)[None, :, None], 48, 0).repeat(3, 2)
    assert cv2.imwrite(str(folder / "frames" / "color" / "8.jpg"), ramp, [cv2.IMWRITE_JPEG_QUALITY, 100])
    sequence = open_sequence(folder)
    assert sequence.camera.fx == 30 and sequence.camera.cx == 15.5
    color = sequence.frame(0).color[12, 4:28, 0].astype(float)
    # The ray through depth column u hits colour column (u - 15.5) * 60 / 30 + 31.
    expected = 3 * ((np.arange(4, 28) - 15.5) * 2 + 31)
    assert np.abs(color - expected).max() < 3


def test_folder_with_matrix_poses_and_other_names(make: Make) -> None:
    folder = make("folder")
    lines = [" ".join(map(str, expected_pose(i).ravel())) for i in range(5)]
    (folder / "poses.txt").write_text("\n".join(lines))
    for path in (folder / "depth").iterdir():
        path.rename(folder / "depth" / f"depth_{path.stem}.png")
    sequence = open_sequence(folder)
    np.testing.assert_allclose(sequence.ground_truth[4], expected_pose(4), atol=1e-9)
    assert sequence.frame(3).depth[5, 5] == pytest.approx(1.3)
    assert sequence.instance_names == {1: "wall"}


def test_poses_whose_times_go_backwards_are_told_of(make: Make) -> None:
    folder = make("folder")
    with (folder / "camera.yaml").open("a") as calibration:
        calibration.write("\nframe_rate: 10\n")
    assert open_sequence(folder).warnings == []
    lines = (folder / "poses.txt").read_text().splitlines()
    (folder / "poses.txt").write_text("\n".join(reversed(lines)))
    sequence = open_sequence(folder)
    assert sequence.warnings == [
        f"{folder / 'poses.txt'}: times do not increase; the poses are taken in the order of the lines"
    ]
    np.testing.assert_allclose(sequence.ground_truth[0], expected_pose(4), atol=1e-6)


@pytest.mark.parametrize("word", ["nan", "inf", "-inf", "noon"])
def test_a_time_that_is_none_is_named_with_its_line(make: Make, word: str) -> None:
    folder = make("folder")
    (folder / "timestamps.txt").write_text("# seconds\n" + "".join(f"{t}\n" for t in (0.0, 0.1, word, 0.3, 0.4)))
    with pytest.raises(SequenceError, match=rf"timestamps\.txt, line 4: .*'{word}'"):
        open_sequence(folder)


def test_a_missing_colour_image_shifts_no_pose_of_a_folder(make: Make) -> None:
    folder = make("folder")
    lines = [" ".join(map(str, [i / 30, *expected_pose(i)[:3, 3], 0, 0, 0, 1])) for i in range(5)]
    (folder / "poses.txt").write_text("\n".join(lines))
    (folder / "timestamps.txt").unlink(missing_ok=True)
    calibration = folder / "camera.yaml"
    calibration.write_text(calibration.read_text() + "\nframe_rate: 30\n")
    sorted((folder / "rgb").iterdir())[2].unlink()
    sequence = open_sequence(folder)
    for frame, row in enumerate([0, 1, 3, 4]):
        np.testing.assert_allclose(sequence.ground_truth[frame][:3, 3], expected_pose(row)[:3, 3], atol=1e-9)
    assert "1 image has no colour image and is left out" in sequence.warnings[0]


def test_a_missing_frame_shifts_no_pose_of_replica(make: Make) -> None:
    folder = make("replica")
    sorted((folder / "results").glob("frame*"))[2].unlink()
    sequence = open_sequence(folder)
    for frame, row in enumerate([0, 1, 3, 4]):
        np.testing.assert_allclose(sequence.ground_truth[frame], expected_pose(row), atol=1e-6)


def test_colour_larger_than_depth_is_reduced(make: Make) -> None:
    folder = make("folder")
    for i in range(5):
        assert cv2.imwrite(str(folder / "rgb" / f"{i}.png"), np.full((48, 64, 3), 77, np.uint8))
    sequence = open_sequence(folder)
    frame = sequence.frame(0)
    assert frame.color.shape == (24, 32, 3) and frame.depth.shape == (24, 32) and sequence.camera.fx == 30


def test_other_masks(make: Make, tmp_path: Path) -> None:
    folder = make("replica")
    masks = tmp_path / "mine"
    masks.mkdir()
    for i in range(4):
        assert cv2.imwrite(str(masks / f"mask_{i:03d}.png"), np.full((12, 16), 40 + i, np.uint8))
    sequence = open_sequence(folder, masks=masks)
    frame = sequence.frame(3)
    assert frame.mask is not None and frame.mask.shape == (24, 32) and (frame.mask == 43).all()
    assert sequence.frame(4).mask is None


def test_depth_scale_override(make: Make) -> None:
    assert open_sequence(make("replica"), depth_scale=500).frame(0).depth[5, 5] == pytest.approx(2.0)


def test_shared_recordings(shared_data: Path) -> None:
    counts = {"livingroom": 200, "redkitchen": 250, "rgbd_dataset_freiburg3_cabinet": 58, "shelf": 15}
    for name, count in counts.items():
        sequence = open_sequence(shared_data / name, scale=0.5)
        assert len(sequence) == count
        frame = sequence.frame(count - 1)
        assert frame.color.shape == (240, 320, 3) and frame.T_world_camera is not None
        assert 0.3 < np.median(frame.depth[frame.depth > 0]) < 3


def test_tum_tells_how_late_depth_is(make: Make) -> None:
    folder = make("tum")
    sequence = open_sequence(folder)
    color, depth = (
        float((folder / name).read_text().splitlines()[-1].split()[0]) for name in ("rgb.txt", "depth.txt")
    )
    assert sequence.frame(len(sequence) - 1).depth_delay == pytest.approx(depth - color, abs=1e-6)
    assert open_sequence(make("replica")).frame(0).depth_delay == 0.0
