# SPDX-License-Identifier: Apache-2.0
"""Folders for other trainers and the trajectory of one run, exported by the command line and read by others: as the
formats are described, by pycolmap and evo where they are installed."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import succeed
from splat_maps import ply_elements, stack

from ggslam.runs.folder import RunFolder
from ggslam.sequences import open_sequence

FRAMES, HELD_OUT = 10, [4]


@pytest.fixture(scope="module")
def poses(room_run: RunFolder) -> dict[int, np.ndarray]:
    """T_world_camera by frame."""
    found = room_run.keyframes().poses()
    assert len(found) == FRAMES
    return found


@pytest.fixture(scope="module")
def colmap(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("colmap") / "out"
    said = succeed("export", room_run.path, "--format", "colmap", "--voxel", 0.03, "--out", out)
    assert "10 images of 160x120 (1 held out)" in said
    return out


@pytest.fixture(scope="module")
def nerfstudio(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("nerfstudio") / "out"
    succeed("export", room_run.path, "--format", "nerfstudio", "--voxel", 0.03, "--out", out)
    return out


def matrix(wxyz: np.ndarray) -> np.ndarray:
    """The rotation of a unit quaternion."""
    (w, *v), (x, y, z) = wxyz, wxyz[1:]
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (w * w - np.dot(v, v)) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * across


def seen_depth(points: np.ndarray, T_camera_world: np.ndarray, K: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Nearest depth of points in each pixel of an image whose top-left pixel's centre is (0.5, 0.5); inf: none."""
    camera = points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    camera = camera[camera[:, 2] > 0.1]
    u, v, w = (camera @ K.T).T
    column, row = np.floor(u / w).astype(int), np.floor(v / w).astype(int)
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    depth = np.full(shape, np.inf)
    np.minimum.at(depth, (row[inside], column[inside]), camera[inside, 2])
    return depth


def check_points_are_in_the_picture(
    points: np.ndarray, T_camera_world: np.ndarray, K: np.ndarray, measured: np.ndarray
) -> None:
    found = seen_depth(points, T_camera_world, K, measured.shape)
    both = np.isfinite(found) & (measured > 0)
    assert both.sum() > 3000 and np.median(np.abs(found - measured)[both]) < 0.03


@dataclass(frozen=True)
class Model:
    """What stands in a COLMAP folder: intrinsics, T_camera_world by image name, points and colours."""

    size: tuple[int, int]
    K: np.ndarray
    T_camera_world: dict[str, np.ndarray]
    points: np.ndarray
    colors: np.ndarray


def as_described(folder: Path) -> Model:
    """COLMAP's binary model, by its documentation."""
    data = (folder / "cameras.bin").read_bytes()
    count, _, pinhole, width, height, fx, fy, cx, cy = struct.unpack("<QIiQQ4d", data)
    assert (count, pinhole) == (1, 1)
    data = (folder / "images.bin").read_bytes()
    poses, place = {}, 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        numbers = struct.unpack_from("<I7dI", data, place)
        end = data.index(b"\0", place + 64)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = matrix(np.array(numbers[1:5])), numbers[5:8]
        poses[data[place + 64 : end].decode()] = T
        (observations,) = struct.unpack_from("<Q", data, end + 1)
        place = end + 9 + 24 * observations
    assert place == len(data)
    data = (folder / "points3D.bin").read_bytes()
    row = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
    points = np.frombuffer(data, row, offset=8)
    assert len(points) == struct.unpack_from("<Q", data)[0] and not points["track"].any()
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Model((width, height), K, poses, points["xyz"], points["rgb"])


def by_pycolmap(folder: Path) -> Model:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed (extra [test])")
    model = pycolmap.Reconstruction(str(folder))
    (camera,) = model.cameras.values()
    assert camera.model.name == "PINHOLE"
    poses = {image.name: np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in model.images.values()}
    points = [model.points3D[number] for number in sorted(model.points3D)]
    return Model((camera.width, camera.height), camera.calibration_matrix(), poses,
                 np.array([p.xyz for p in points]), np.array([p.color for p in points]))  # fmt: skip


@pytest.mark.parametrize("reader", [as_described, by_pycolmap])
def test_colmap(reader: object, colmap: Path, room: Path, poses: dict[int, np.ndarray]) -> None:
    model, sequence = reader(colmap / "sparse" / "0"), open_sequence(room)  # type: ignore[operator]
    K = sequence.camera.matrix()
    K[:2, 2] += 0.5
    assert model.size == (160, 120) and len(model.T_camera_world) == FRAMES and len(model.points) > 1000
    np.testing.assert_allclose(model.K, K)
    assert model.colors.std() > 20
    for name, T_camera_world in model.T_camera_world.items():
        index = int(name[6:12])
        np.testing.assert_allclose(np.linalg.inv(T_camera_world), poses[index], atol=1e-9)
        stored = cv2.imread(str(colmap / "images" / name))[..., ::-1]
        np.testing.assert_array_equal(stored, sequence.frame(index).color)
        check_points_are_in_the_picture(model.points, T_camera_world, model.K, sequence.frame(index).depth)
    names = (colmap / "sparse" / "0" / "test.txt").read_text().split()
    assert names == [f"frame_{index:06d}.png" for index in HELD_OUT]


def test_nerfstudio(nerfstudio: Path, room: Path, poses: dict[int, np.ndarray]) -> None:
    """Read with json and OpenCV."""
    values = json.loads((nerfstudio / "transforms.json").read_text())
    assert values["val_filenames"] == values["test_filenames"] == [f"images/frame_{i:06d}.png" for i in HELD_OUT]
    names = [frame["file_path"] for frame in values["frames"]]
    assert sorted(values["train_filenames"] + values["test_filenames"]) == names and len(names) == FRAMES
    assert values["camera_model"] == "OPENCV" and not any(values[name] for name in ("k1", "k2", "p1", "p2"))
    K = np.array([[values["fl_x"], 0, values["cx"]], [0, values["fl_y"], values["cy"]], [0, 0, 1]])
    points = stack(ply_elements(nerfstudio / values["ply_file_path"])["vertex"], *"xyz")
    sequence = open_sequence(room)
    for index, frame in enumerate(values["frames"]):
        T_world_camera = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])  # from y up, z backwards
        np.testing.assert_allclose(T_world_camera, poses[index], atol=1e-12)
        color = cv2.imread(str(nerfstudio / frame["file_path"]))[..., ::-1]
        depth = cv2.imread(str(nerfstudio / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(color, sequence.frame(index).color)
        assert color.shape == (values["h"], values["w"], 3) and depth.dtype == np.uint16
        np.testing.assert_allclose(depth / 1000, sequence.frame(index).depth, atol=0.00051)
        check_points_are_in_the_picture(points, np.linalg.inv(T_world_camera), K, depth / 1000)


@pytest.fixture(scope="module")
def trajectory(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trajectory") / "poses.txt"
    succeed("export", room_run.path, "--out", out)
    return out


def test_trajectory(trajectory: Path, poses: dict[int, np.ndarray]) -> None:
    rows = np.loadtxt(trajectory)
    assert rows.shape == (FRAMES, 8) and (np.diff(rows[:, 0]) > 0).all()
    for row, T in zip(rows, poses.values(), strict=True):
        np.testing.assert_allclose(row[1:4], T[:3, 3], atol=1e-8)
        np.testing.assert_allclose(matrix(row[[7, 4, 5, 6]]), T[:3, :3], atol=1e-7)


def test_trajectory_by_evo(trajectory: Path, poses: dict[int, np.ndarray]) -> None:
    pytest.importorskip("evo", reason="evo is not installed (its licence is GPL: in no extra)")
    from evo.tools import file_interface

    found = file_interface.read_tum_trajectory_file(str(trajectory))
    assert found.check()[0]
    np.testing.assert_allclose(found.poses_se3, list(poses.values()), atol=1e-7)
