# SPDX-License-Identifier: Apache-2.0
"""`ggslam export --format mesh`: opened by trimesh; with the recording, without it, and after an edit."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from ggslam.cli.main import app
from ggslam.errors import ConfigError, FormatError, GgslamError, SequenceError
from ggslam.jobs.export.export_run import export_run
from ggslam.jobs.export.meshes import MeshRequest, export_mesh
from ggslam.runs.folder import RunFolder
from ggslam.scene.poses import transform_points
from ggslam.sequences import open_sequence

trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed (extra [mesh]; an independent reader)")
VOXEL = 0.04
MESH = ("--format", "mesh", "--voxel", VOXEL)


def ggslam(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "200"})
    if isinstance(result.exception, GgslamError):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def recording(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(room, tmp_path_factory.mktemp("mesh") / "room"))


@pytest.fixture(scope="module")
def run(recording: Path) -> RunFolder:
    out = recording.parent / "run"
    ggslam("run", recording, "--out", out, "--stop", 10, "--iterations", 2, "--no-eval")
    return RunFolder.open(out)


def measured(run: RunFolder, recording: Path) -> np.ndarray:
    """Points that the depth camera saw, in the run's world."""
    poses, sequence = run.keyframes().poses(), open_sequence(recording, stop=10)
    clouds = []
    for index, T in poses.items():
        points = sequence.camera.back_project(sequence.frame(index).depth).reshape(-1, 3)
        clouds.append(transform_points(points[points[:, 2] > 0], T))
    return np.concatenate(clouds)[::37]


def test_glb_has_a_node_for_each_object_and_lies_on_what_was_seen(
    run: RunFolder, recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "room.glb"
    said = ggslam("export", run.path, *MESH, "--out", out)
    assert "10 depth images of the recording" in said
    scene = trimesh.load(out)
    names = {f"{o.id} {o.name}" for o in run.object_table().objects}
    nodes = set(scene.graph.nodes_geometry)
    assert len(nodes & names) > 10 and nodes <= names | {"unlabelled"}
    vertices = np.concatenate([geometry.vertices for geometry in scene.geometry.values()])
    far = cKDTree(vertices).query(measured(run, recording))[0]
    assert np.median(far) < VOXEL and (far < 2 * VOXEL).mean() > 0.95
    colors = [g.visual.vertex_attributes["color"] for g in scene.geometry.values() if len(g.vertices) > 500]
    assert colors and all(part[:, :3].std() > 0 for part in colors)


def test_rendered_depth_gives_the_same_surface(run: RunFolder, recording: Path, tmp_path: Path) -> None:
    said = ggslam("export", run.path, "--format", "mesh", "--rendered", "--voxel", VOXEL, "--out", tmp_path / "map.ply")
    keyframes = len(run.keyframes().keyframes)
    assert f"rendered at {keyframes} keyframes" in said
    mesh = trimesh.load(tmp_path / "map.ply")
    far = cKDTree(mesh.vertices).query(measured(run, recording))[0]
    assert np.median(far) < VOXEL and (far < 2 * VOXEL).mean() > 0.9


def test_without_the_recording_depth_is_rendered_and_one_is_told(
    run: RunFolder, recording: Path, tmp_path: Path
) -> None:
    away = recording.rename(recording.with_name("moved"))
    try:
        said = ggslam("export", run.path, *MESH, "--out", tmp_path / "map.ply")
        assert "depth is rendered from the map" in said and "no such folder" in said
        found = ggslam(
            "export",
            run.path,
            "--format",
            "mesh",
            "--voxel",
            VOXEL,
            "--sequence",
            away,
            "--out",
            tmp_path / "room.ply",
        )
        assert "depth images of the recording" in found
        with pytest.raises(SequenceError, match="nowhere"):  # what was asked for is not replaced by something else
            export_mesh(run, tmp_path / "x.ply", MeshRequest(recording=Path("nowhere")))
    finally:
        away.rename(recording)


@pytest.mark.parametrize("ending", ["obj", "glb", "ply"])
def test_on_the_floor(run: RunFolder, recording: Path, tmp_path: Path, ending: str) -> None:
    """The synthetic floor, z = 0 of the recording's poses, is z = 0 of the file (y of glTF) within 5 mm, at the places
    of the mesh in the map's frame, and floor.yaml tells where that is."""
    out = tmp_path / f"room.{ending}"
    said = ggslam("export", run.path, *MESH, "--frame", "floor", "--out", out)
    assert f"{tmp_path / 'floor.yaml'}: ros2 run tf2_ros static_transform_publisher --x" in said
    told = yaml.safe_load((tmp_path / "floor.yaml").read_text())
    T_floor_map = np.array(told["T_floor_map"]).reshape(4, 4)
    found = trimesh.load(out, process=False)
    points = np.asarray(found.to_geometry().vertices if ending == "glb" else found.vertices)
    if ending == "glb":
        points = points @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]).T  # y up to z up
    ggslam("export", run.path, *MESH, "--out", tmp_path / "map.ply")
    of_map = transform_points(np.asarray(trimesh.load(tmp_path / "map.ply", process=False).vertices), T_floor_map)
    assert cKDTree(points).query(of_map)[0].max() < 1e-4
    first = open_sequence(recording).frame(0).T_world_camera  # where the map begins; z = 0 of the scene is its floor
    assert first is not None
    T_scene_file = first @ np.linalg.inv(T_floor_map)
    floor = points[np.abs(transform_points(points, T_scene_file)[:, 2]) < 0.03]
    assert len(floor) > 300 and abs(np.median(floor[:, 2])) < 0.005
    with pytest.raises(ConfigError, match="`frame`.*mesh.*points"):
        export_run(run, tmp_path / "points", "points", frame="floor")
    with pytest.raises(ConfigError, match="`frame`.*map.*floor.*'roof'"):
        export_run(run, out, "mesh", frame="roof")


def test_single_objects(run: RunFolder, tmp_path: Path) -> None:
    said = ggslam("export", run.path, *MESH, "--objects", "sofa,rug", "--out", tmp_path / "o")
    assert "2 objects" in said
    files = sorted(path.name for path in (tmp_path / "o").iterdir())
    ids = {o.name: o.id for o in run.object_table().objects}
    assert files == sorted([f"{ids['sofa']}_sofa.ply", f"{ids['rug']}_rug.ply"])
    export_mesh(run, tmp_path / "two.glb", MeshRequest(VOXEL, objects="sofa,rug"))
    scene = trimesh.load(tmp_path / "two.glb")
    assert set(scene.graph.nodes_geometry) == {f"{ids['sofa']} sofa", f"{ids['rug']} rug"}
    sofa = trimesh.load(tmp_path / "o" / f"{ids['sofa']}_sofa.ply")
    assert len(sofa.faces) == len(scene.geometry[f"{ids['sofa']} sofa"].faces) > 100


def test_an_edited_run_shows_the_edit(run: RunFolder, tmp_path: Path) -> None:
    edited = tmp_path / "without"
    ggslam("edit", run.path, "--remove", "sofa", "--out", edited)
    said = ggslam("export", edited, *MESH, "--out", tmp_path / "edited.glb")
    assert "the run was edited" in said
    nodes = set(trimesh.load(tmp_path / "edited.glb").graph.nodes_geometry)
    sofa = next(o.id for o in run.object_table().objects if o.name == "sofa")
    assert f"{sofa} sofa" not in nodes and len(nodes) > 8


def test_what_cannot_be(run: RunFolder, tmp_path: Path) -> None:
    for request, name, kind, word in (
        (MeshRequest(), "mesh.stl", FormatError, ".glb"),
        (MeshRequest(voxel=0), "mesh.ply", ConfigError, "voxel"),
        (MeshRequest(VOXEL, objects="unicorn"), "o", ConfigError, "unicorn"),
    ):
        with pytest.raises(kind, match=word):
            export_mesh(run, tmp_path / name, request)
    with pytest.raises(ConfigError, match="--rendered"):
        ggslam("export", run.path, "--format", "ply", "--rendered", "--out", tmp_path / "map.ply")
    assert not list(tmp_path.iterdir())
