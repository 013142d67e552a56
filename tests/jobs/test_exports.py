# SPDX-License-Identifier: Apache-2.0
"""What a run exports, opened by programs that know nothing of ggslam."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from ggslam.cli.main import app
from ggslam.errors import ConfigError, FormatError, GgslamError, RunFolderError
from ggslam.formats.point_cloud import read_point_cloud
from ggslam.jobs.export.export_run import export_run
from ggslam.jobs.export.formats import ExportFormat, choose_format
from ggslam.jobs.export.splats import ENDINGS, export_packed, export_pcd
from ggslam.jobs.export.views import export_colmap, export_nerfstudio
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import SequenceRequest, describe
from ggslam.scene.poses import quaternion_to_matrix
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam

HELD_OUT = [4, 12]


@pytest.fixture(scope="module")
def run(room: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    config = load_config(None, ["mapping.iterations_per_frame=1"])
    request = SequenceRequest(room, stop=14)
    sequence = request.open()
    slam = Slam(sequence.camera, config)
    for frame in sequence.stream(masks=False):
        slam.step(frame)
    folder = RunFolder.create(tmp_path_factory.mktemp("exports") / "run")
    folder.save(config, describe(request, sequence), slam.finish())
    return folder


def poses(run: RunFolder) -> dict[int, np.ndarray]:
    return run.keyframes().poses()


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


def test_colmap_folder_in_pycolmap(run: RunFolder, room: Path, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed (an independent reader)")
    line = export_colmap(run, tmp_path / "colmap", voxel_size=0.03)
    assert "14 images of 160x120 (2 held out)" in line
    model = pycolmap.Reconstruction(str(tmp_path / "colmap" / "sparse" / "0"))
    assert len(model.images) == 14 and len(model.cameras) == 1 and len(model.points3D) > 1000
    camera, sequence = model.cameras[1], open_sequence(room)
    K = sequence.camera.matrix()
    assert camera.model.name == "PINHOLE" and (camera.width, camera.height) == (160, 120)
    np.testing.assert_allclose(camera.params, [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5])
    points = np.array([point.xyz for point in model.points3D.values()])
    for image in model.images.values():
        index = int(image.name[6:12])
        T_camera_world = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        np.testing.assert_allclose(np.linalg.inv(T_camera_world), poses(run)[index], atol=1e-9)
        stored = cv2.imread(str(tmp_path / "colmap" / "images" / image.name))[..., ::-1]
        np.testing.assert_array_equal(stored, sequence.frame(index).color)
        depth = seen_depth(points, T_camera_world, camera.calibration_matrix(), (120, 160))
        measured = sequence.frame(index).depth
        both = np.isfinite(depth) & (measured > 0)
        assert both.sum() > 3000 and np.median(np.abs(depth - measured)[both]) < 0.03  # the points are in the pictures
    names = (tmp_path / "colmap" / "sparse" / "0" / "test.txt").read_text().split()
    assert names == [f"frame_{index:06d}.png" for index in HELD_OUT]


def test_nerfstudio_folder(run: RunFolder, room: Path, tmp_path: Path) -> None:
    """Read with nothing but json, OpenCV and the words of nerfstudio's documentation."""
    out = tmp_path / "nerfstudio"
    export_nerfstudio(run, out, voxel_size=0.03)
    values = json.loads((out / "transforms.json").read_text())
    assert values["val_filenames"] == values["test_filenames"] == [f"images/frame_{i:06d}.png" for i in HELD_OUT]
    names = [frame["file_path"] for frame in values["frames"]]
    assert sorted(values["train_filenames"] + values["test_filenames"]) == names and len(names) == 14
    K = np.array([[values["fl_x"], 0, values["cx"]], [0, values["fl_y"], values["cy"]], [0, 0, 1]])
    cloud = read_point_cloud(out / values["ply_file_path"])
    sequence = open_sequence(room)
    for index, frame in enumerate(values["frames"]):
        T_world_camera = np.array(frame["transform_matrix"])  # camera axes: x right, y up, z backwards
        np.testing.assert_allclose(T_world_camera @ np.diag([1, -1, -1, 1]), poses(run)[index], atol=1e-12)
        color = cv2.imread(str(out / frame["file_path"]))[..., ::-1]
        depth = cv2.imread(str(out / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        measured = sequence.frame(index).depth
        assert color.shape == (values["h"], values["w"], 3) and depth.dtype == np.uint16
        np.testing.assert_allclose(depth / 1000, measured, atol=0.00051)
        T_camera_world = np.linalg.inv(T_world_camera @ np.diag([1, -1, -1, 1]))
        of_points = seen_depth(cloud.points, T_camera_world, K, depth.shape)
        both = np.isfinite(of_points) & (depth > 0)
        assert both.sum() > 3000 and np.median(np.abs(of_points - depth / 1000)[both]) < 0.03


def test_only_keyframes_and_what_is_held_out(run: RunFolder, tmp_path: Path) -> None:
    export_nerfstudio(run, tmp_path / "few", voxel_size=0.05, keyframes_only=True)
    values = json.loads((tmp_path / "few" / "transforms.json").read_text())
    keyframes = run.keyframes().keyframe_numbers()
    found = {int(frame["file_path"][-10:-4]) for frame in values["frames"]}
    assert found == keyframes | set(HELD_OUT) and len(found) < 14
    assert len(list((tmp_path / "few" / "images").iterdir())) == len(found)


def test_a_folder_with_something_in_it_is_left_alone(run: RunFolder, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    for export in (export_colmap, export_nerfstudio):
        with pytest.raises(RunFolderError, match="not an empty folder"):
            export(run, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_pcd_in_open3d(run: RunFolder, tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d", reason="open3d is not installed (an independent reader)")
    export_pcd(run, tmp_path / "cloud.pcd", 0.03)
    seen = open3d.io.read_point_cloud(str(tmp_path / "cloud.pcd"))
    own = read_point_cloud(tmp_path / "cloud.pcd")
    np.testing.assert_array_equal(np.asarray(seen.points), own.points)
    np.testing.assert_array_equal(np.rint(np.asarray(seen.colors) * 255), own.colors)
    assert len(own) > 1000


def test_trajectory_in_numpy(run: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "trajectory.txt"
    result = CliRunner().invoke(app, ["export", str(run.path), "--format", "trajectory", "--out", str(out)])
    assert result.exit_code == 0, result.output
    rows = np.loadtxt(out)
    assert rows.shape == (14, 8) and (np.diff(rows[:, 0]) > 0).all()
    for row, T in zip(rows, poses(run).values(), strict=True):
        np.testing.assert_allclose(row[1:4], T[:3, 3], atol=1e-8)
        np.testing.assert_allclose(quaternion_to_matrix(row[[7, 4, 5, 6]]), T[:3, :3], atol=1e-7)


@pytest.mark.parametrize("kind", ["compressed-ply", "spz", "spz4", "splat"])
def test_splats_by_the_command_line(run: RunFolder, tmp_path: Path, kind: str) -> None:
    if kind in ("spz", "spz4"):
        pytest.importorskip("gaussforge", reason="gaussforge is not installed (extra [splats])")
        pytest.importorskip("zstandard", reason="zstandard is not installed (extra [splats])")
    out = tmp_path / f"map{ENDINGS[kind]}"
    faint = export_packed(run, out, kind)
    result = CliRunner().invoke(
        app, ["export", str(run.path), "--format", kind, "--out", str(out), "--min-opacity", "0.6"]
    )
    assert result.exit_code == 0, result.output
    opaque = int((run.gaussians().opacities >= 0.6).sum())
    assert f"{opaque} Gaussians" in result.output.replace("\n", " ") and f"{len(run.gaussians())} Gaussians" in faint
    if kind == "splat":
        assert out.stat().st_size == 32 * opaque


def gltf_of(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


def test_gltf_by_the_command_line(run: RunFolder, tmp_path: Path) -> None:
    """A .glb is a mesh unless the format is given; object ids are the last column."""
    out, gaussians = tmp_path / "splats.glb", run.gaussians()
    opaque = gaussians.opacities >= 0.6
    result = CliRunner().invoke(
        app, ["export", str(run.path), "--format", "gltf", "--out", str(out), "--min-opacity", "0.6"]
    )
    assert result.exit_code == 0, result.output
    count = int(opaque.sum())
    assert f"{count} Gaussians" in result.output.replace("\n", " ")
    gltf = gltf_of(out)
    assert {accessor["count"] for accessor in gltf["accessors"]} == {count}
    assert run.has_objects()
    assert list(gltf["meshes"][0]["primitives"][0]["extensions"]) == ["KHR_gaussian_splatting", "EXT_mesh_features"]
    ids = np.frombuffer(out.read_bytes()[-4 * count :], "<f4")
    np.testing.assert_array_equal(ids, gaussians.object_id[opaque])
    assert list(gltf["meshes"][0]["extras"]["objects"]) == [str(i) for i in run.object_table().ids()]


def test_gltf_plain_and_of_objects(run: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "splats.glb"
    export_run(run, out, "gltf", plain=True)
    gltf = gltf_of(out)
    assert list(gltf["meshes"][0]["primitives"][0]["extensions"]) == ["KHR_gaussian_splatting"]
    assert "extras" not in gltf["meshes"][0]
    object_id, gaussians = run.object_table().ids()[0], run.gaussians()
    export_run(run, out, "gltf", objects=str(object_id))
    gltf, count = gltf_of(out), int((gaussians.object_id == object_id).sum())
    assert {accessor["count"] for accessor in gltf["accessors"]} == {count}
    assert list(gltf["meshes"][0]["extras"]["objects"]) == [str(object_id)]
    with pytest.raises(FormatError, match=r"ends in \.glb"):
        export_run(run, tmp_path / "splats.gltf", "gltf")
    assert choose_format(None, out, None) is ExportFormat.mesh


def test_a_map_on_disk_is_written_cell_by_cell(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, first = tmp_path / "whole.splat", len(run.gaussians()) // 3
    export_packed(run, whole, "splat")
    copy = tmp_path / "run"
    shutil.copytree(run.path, copy)
    box = {"low": [-9, -9, -9], "high": [9, 9, 9]}
    cells = [{"cell": [0, 0, 0], "start": 0, "count": first, **box},
             {"cell": [1, 0, 0], "start": first, "count": len(run.gaussians()) - first, **box}]  # fmt: skip
    (copy / "map_cells.json").write_text(json.dumps({"version": 1, "cells": cells}))
    monkeypatch.setattr(RunFolder, "gaussians", None)  # the whole map is not asked for
    export_packed(RunFolder.open(copy), tmp_path / "parts.splat", "splat")
    assert (tmp_path / "parts.splat").read_bytes() == whole.read_bytes()


def refused(*arguments: str) -> GgslamError:
    error = CliRunner().invoke(app, ["export", *arguments]).exception
    assert isinstance(error, GgslamError)
    return error


def test_what_does_not_go_together(run: RunFolder, tmp_path: Path) -> None:
    out = ["--out", str(tmp_path / "map.ply")]
    assert "says ply, but --format says spz" in str(refused(str(run.path), "--format", "spz", *out))
    assert "says ply, but --format says pcd" in str(refused(str(run.path), "--format", "pcd", *out))
    assert isinstance(refused(str(run.path), "--format", "splat", "--keyframes", *out), ConfigError)
    assert isinstance(refused(str(run.path), "--format", "colmap", "--voxel", "0", *out), ConfigError)
    with pytest.raises(RunFolderError, match="nothing to export"):
        export_packed(run, tmp_path / "map.splat", "splat", min_opacity=1.1)
    assert not list(tmp_path.iterdir())
