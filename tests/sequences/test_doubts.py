# SPDX-License-Identifier: Apache-2.0
"""Faults planted in a generated recording are told by `inspect_sequence`; healthy recordings are not doubted."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse
from ggslam.sequences import inspect_sequence, open_sequence
from ggslam.sequences.alignment import measure_alignment
from ggslam.sequences.scale_doubts import floor_height
from ggslam.sequences.verdicts import ScaleSigns, judge_scale_signs

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture
def copy(room: Path, tmp_path: Path) -> Path:
    """The room with files of its own for everything but the images."""
    folder = tmp_path / "copy"
    folder.mkdir()
    for path in room.iterdir():
        if path.is_dir():
            (folder / path.name).symlink_to(path)
        else:
            shutil.copy(path, folder / path.name)
    return folder


def warnings_of(folder: Path, **options: float) -> list[str]:
    return inspect_sequence(open_sequence(folder, **options)).warnings  # type: ignore[arg-type]


def test_healthy(room: Path) -> None:
    report = inspect_sequence(open_sequence(room))
    assert report.warnings == []
    assert report.pose_depth_error is not None and report.pose_depth_error < 0.01
    assert report.alignment is not None and report.alignment.strength > 0.4


@pytest.mark.long("four true recordings")
def test_healthy_shared_recordings(shared_data: Path) -> None:
    for name in ("livingroom", "redkitchen", "rgbd_dataset_freiburg3_cabinet", "shelf"):
        assert warnings_of(shared_data / name, scale=0.5) == [], name


@pytest.mark.parametrize(("scale", "told"), [(5000.0, 0), (25000.0, 1), (1000.0, 1)])
def test_depth_scale_by_the_size_of_things(copy: Path, scale: float, told: int) -> None:
    """The room's depth has 5000 units a metre. A doll's house has everything small: depth, floor, and motion."""
    (copy / "poses.txt").unlink()
    found = [text for text in warnings_of(copy, depth_scale=scale) if "depth scale" in text]
    assert len(found) == told
    if scale > 5000:
        assert f"depth scale {scale:g} is doubtful if this is a room" in found[0] and "above the floor" in found[0]


def test_what_is_small_is_not_doubted_unless_all_of_it_is() -> None:
    doll = ScaleSigns(near=0.12, median=0.37, far=0.72, floor=0.14, speed=0.17)
    assert "try `depth_scale` 1000" in judge_scale_signs(5000, doll)[0].text
    assert judge_scale_signs(1000, doll) == []  # millimetres of something near
    for change in ({"near": 0.4, "floor": None}, {"far": 2.0}, {"floor": 1.2}, {"speed": 0.8}, {"median": 1.0}):
        assert judge_scale_signs(5000, dataclasses.replace(doll, **change)) == []  # type: ignore[arg-type]
    hall = ScaleSigns(near=2.0, median=5.5, far=18.0, floor=None, speed=None)
    assert "try `depth_scale` 4000" in judge_scale_signs(1000, hall)[0].text
    assert judge_scale_signs(1000, dataclasses.replace(hall, floor=1.3)) == []


def test_the_floor_is_found_at_its_height() -> None:
    camera = Camera(64, 48, 50, 50, 31.5, 23.5)
    rays = camera.rays()
    depth = np.where(rays[..., 1] > 0.1, 1.4 / np.maximum(rays[..., 1], 1e-6), 3.0).astype(np.float32)
    frame = Frame(0, 0, 0.0, np.zeros((48, 64, 3), np.uint8), depth, camera)
    assert floor_height(frame) == pytest.approx(1.4, rel=0.01)
    frame.depth[24:] = 3.0  # a wall alone
    assert floor_height(frame) is None


@pytest.mark.parametrize("factor", [5.0, 0.2, 6.5535])
def test_depth_scale(room: Path, factor: float) -> None:
    true = open_sequence(room).depth_scale
    told = [text for text in warnings_of(room, depth_scale=true * factor) if "is suspicious" in text]
    assert len(told) == 1 and f"depth scale {true * factor:g} is suspicious" in told[0]
    assert f"try `depth_scale` {true:g}" in told[0]


def test_depth_scale_without_poses(copy: Path) -> None:
    """Only what no room looks like can be told."""
    (copy / "poses.txt").unlink()
    true = open_sequence(copy).depth_scale
    assert warnings_of(copy) == []
    (text,) = warnings_of(copy, depth_scale=true / 5)  # as large as a street
    assert "is doubtful if this is a room: the median depth is" in text and "outdoors it may be right" in text
    assert any("is suspicious: the median depth is" in text for text in warnings_of(copy, depth_scale=true / 50))


def assert_remedy(recording: Path, option: str, poses: np.ndarray) -> None:
    """What the warning advises gives the true poses, and leaves nothing to warn of."""
    sequence = open_sequence(recording, pose_convention=option)
    np.testing.assert_allclose(sequence.ground_truth, poses, atol=1e-6)
    assert not inspect_sequence(sequence).warnings


@pytest.mark.parametrize(
    ("name", "option", "change"),
    [
        ("world to camera", "world-to-camera", inverse),
        ("OpenGL camera axes", "opengl", lambda T: T @ FLIP_YZ),
        ("world to camera with OpenGL axes", "world-to-camera-opengl", lambda T: inverse(T @ FLIP_YZ)),
    ],
)
def test_pose_convention(copy: Path, name: str, option: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    poses = open_sequence(copy).ground_truth
    assert poses is not None
    (copy / "poses.txt").write_text("".join(" ".join(map(str, change(T).ravel())) + "\n" for T in poses))
    (text,) = warnings_of(copy)
    assert f"the true poses look like {name}" in text and text.endswith(f"try `pose_convention` {option}")
    assert_remedy(copy, option, poses)


def test_quaternion_order(copy: Path) -> None:
    from scipy.spatial.transform import Rotation

    poses = open_sequence(copy).ground_truth
    assert poses is not None
    lines = []
    for i, T in enumerate(poses):
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        lines.append(" ".join(map(str, (i / 30, *T[:3, 3], w, x, y, z))))
    (copy / "poses.txt").write_text("\n".join(lines))
    (text,) = warnings_of(copy)
    assert "the true poses look like quaternions in the order wxyz" in text
    assert text.endswith("try `pose_convention` wxyz")
    assert_remedy(copy, "wxyz", poses)


def misplaced(depth: np.ndarray, shift: tuple[float, float], scale: float) -> np.ndarray:
    """A depth image moved, and enlarged about its centre."""
    height, width = depth.shape
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    warp = np.column_stack([scale * np.eye(2), shift + (1 - scale) * centre])
    return cv2.warpAffine(depth, warp, (width, height), flags=cv2.INTER_NEAREST)


@pytest.mark.parametrize("name", ["livingroom", "redkitchen", "rgbd_dataset_freiburg3_cabinet"])
def test_misaligned_real_images(shared_data: Path, name: str) -> None:
    sequence = open_sequence(shared_data / name, scale=0.5)
    frames = [sequence.frame(i) for i in np.linspace(0, len(sequence) - 1, 5).astype(int)]
    for shift, scale in (((9, 0), 1.0), ((-7, 7), 1.0), ((0, 0), 1.08), ((0, 0), 0.92)):
        moved = [dataclasses.replace(frame, depth=misplaced(frame.depth, shift, scale)) for frame in frames]
        found = measure_alignment(moved)
        assert found is not None and found.doubtful
        assert np.abs(np.array(found.shift) * 320 + shift).max() <= 3
        assert found.scale == pytest.approx(1 / scale, abs=0.03)


@pytest.mark.parametrize(
    ("shift", "scale"), [((6, 0), 1.0), ((0, -5), 1.0), ((-5, 4), 1.0), ((0, 0), 0.88)]
)
def test_misaligned(copy: Path, shift: tuple[int, int], scale: float) -> None:
    source = (copy / "depth").resolve()
    (copy / "depth").unlink()
    (copy / "depth").mkdir()
    for path in source.iterdir():
        moved = misplaced(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), shift, scale)
        assert cv2.imwrite(str(copy / "depth" / path.name), moved)
    report = inspect_sequence(open_sequence(copy))
    told = "depth does not lie on colour" if scale == 1 else "depth is not registered to colour"
    assert sum(told in text for text in report.warnings) == 1
    assert report.alignment is not None
    found = np.array(report.alignment.shift) * 160
    assert np.abs(found + shift).max() <= 2 and report.alignment.scale == pytest.approx(1 / scale, abs=0.04)


def test_a_convention_that_is_none(copy: Path) -> None:
    with pytest.raises(SequenceError, match="opencv, world-to-camera, opengl"):
        open_sequence(copy, pose_convention="opengles")
    (copy / "poses.txt").unlink()
    with pytest.raises(SequenceError, match=f"{copy.name}.*poses"):
        open_sequence(copy, pose_convention="opengl")
