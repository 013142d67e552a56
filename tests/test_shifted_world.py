# SPDX-License-Identifier: Apache-2.0
"""Every command that takes or gives world coordinates, on an input and on the same moved to UTM coordinates: what comes
out differs by that motion alone, to 0.1 mm or what the input's own digits allow."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed
from scipy.spatial import cKDTree
from worlds.cloud import cloud_tiles
from worlds.plan import make_world
from worlds.scanner import Scanner
from worlds.walk import walk

from ggslam.formats.ply import write_ply
from ggslam.formats.point_cloud import read_point_cloud, write_point_cloud
from ggslam.formats.trajectory import read_tum, write_tum
from ggslam.formats.triangle_mesh import read_mesh
from ggslam.scene.poses import se3_exp, transform_points
from ggslam.submaps.grid import GridStore
from ggslam.submaps.recorder import load_points
from ggslam.volumes.octomap_files import read_octomap

UTM = np.array([463000.0, 5427000.0, 300.0])
DEPTH = ["--set", "volumes.tsdf.max_depth=4"]
MM = 1e-3


class Input(NamedTuple):
    """What commands are given, and how far its world is moved, [3] metres."""

    folder: Path
    offset: np.ndarray

    @property
    def room(self) -> Path:
        return self.folder / "room"

    @property
    def scans(self) -> Path:
        return self.folder / "walk"

    def back(self, points: np.ndarray) -> np.ndarray:
        """World points [n, 3] where they would be without the motion."""
        return np.asarray(points, np.float64) - self.offset


@pytest.fixture(scope="module")
def inputs(room: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Input, Input]:
    """The same near zero and at UTM coordinates: a recording of a room, scans of a walk, and clouds."""
    folder = tmp_path_factory.mktemp("shifted")
    world = make_world(30.0, seed=0)
    poses = walk(world, 2.0, seed=0)[:8]
    scans = [Scanner(columns=450).scan(world, T, number).points for number, T in enumerate(poses)]
    surface = np.concatenate([points for points, _ in cloud_tiles(world, 0.15)])
    surface = surface[np.linalg.norm(surface[:, :2] - poses[0, :2, 3], axis=1) < 8]
    given = tuple(Input(folder / name, at) for name, at in (("near", np.zeros(3)), ("far", UTM)))
    for one in given:
        shutil.copytree(room, one.room)
        path = one.room / "poses.txt"
        found = read_tum(path)
        write_tum(path, found.timestamps, _moved(found.T_world_camera, one.offset))
        (one.scans / "scans").mkdir(parents=True)
        for number, points in enumerate(scans):
            np.save(one.scans / "scans" / f"{number:06d}.npy", points)
        write_tum(one.scans / "trajectory.txt", np.arange(len(poses)) / 10, _moved(poses, one.offset))
        for name, points in (("cloud.ply", surface), ("cloud.pcd", surface), ("scan.ply", _world(scans[0], poses[0]))):
            write_point_cloud(one.folder / name, points.astype(np.float64) + one.offset, {})
        bent = transform_points(_world(scans[1], poses[1]), se3_exp(np.array([0.2, -0.1, 0.05, 0, 0.01, 0.02])))
        write_point_cloud(one.folder / "other.ply", bent + one.offset, {"color": _colors(len(bent))})
    return given[0], given[1]


def _moved(poses: np.ndarray, offset: np.ndarray) -> np.ndarray:
    moved = np.array(poses)
    moved[:, :3, 3] += offset
    return moved


def _world(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    return transform_points(points.astype(np.float64), T)


def _colors(count: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 255, (count, 3)).astype(np.uint8)


def _farthest(one: np.ndarray, other: np.ndarray) -> float:
    """Metres from a point of either cloud to the other, at most."""
    assert len(one) and len(other)
    return float(max(cKDTree(a).query(b)[0].max() for a, b in ((one, other), (other, one))))


def _located(given: Input, out: Path) -> tuple[np.ndarray, dict[str, Any]]:
    poses = read_tum(out / "trajectory.txt").T_world_camera
    return _moved(poses, -given.offset), json.loads((out / "localization.json").read_text())["summary"]


# --- localize --------------------------------------------------------------------------------------------------------


def _in_cloud(given: Input, out: Path, *options: str) -> None:
    succeed("localize", given.folder / "cloud.ply", given.scans, "--start-pose", "given", "--out", out, *options)


def _in_cloud_fully(given: Input, out: Path) -> None:
    _in_cloud(given, out, "--full-map")


def _in_store_of_scans(given: Input, out: Path) -> None:
    store = out.with_suffix(".grid")
    succeed("submaps", given.scans, "--out", store)
    succeed("localize", store, given.scans, "--start-pose", "given", "--out", out)


def _images_in_store(given: Input, out: Path) -> None:
    store = out.with_suffix(".grid")
    succeed("submaps", given.room, "--out", store)
    succeed("localize", store, given.room, "--start-pose", "given", "--stop", 6, "--out", out)


def _images_looked_up(given: Input, out: Path) -> None:
    store = out.with_suffix(".grid")
    succeed("submaps", given.room, "--out", store)
    succeed("localize", store, given.room, "--no-start-pose", "--stop", 3, "--out", out)


@pytest.mark.long("locates scans and images in several kinds of maps, twice")
@pytest.mark.parametrize(
    "job", [_in_cloud, _in_cloud_fully, _in_store_of_scans, _images_in_store, _images_looked_up],
    ids=lambda job: job.__name__.strip("_"),
)  # fmt: skip
def test_localize(inputs: tuple[Input, Input], tmp_path: Path, job: Callable[[Input, Path], None]) -> None:
    found = []
    for given in inputs:
        job(given, tmp_path / given.folder.name)
        found.append(_located(given, tmp_path / given.folder.name))
    (near, summary), (far, summary_far) = found
    assert summary_far["located_share"] == summary["located_share"] == 1.0
    # An image's few points hold it less: from roundings of the last bit it ends within a step that is small enough.
    step = 0.4 * MM if "images" in job.__name__ else 0.1 * MM
    assert np.abs(near[:, :3, 3] - far[:, :3, 3]).max() < step
    assert np.abs(near[:, :3, :3] - far[:, :3, :3]).max() < 2e-4
    assert summary["rmse_m"] < 0.03 and abs(summary_far["rmse_m"] - summary["rmse_m"]) < 0.1 * MM


# --- submaps ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("source", ["walk", "cloud.ply", "cloud.pcd", "room"])
def test_submaps(inputs: tuple[Input, Input], tmp_path: Path, source: str) -> None:
    stored, changed = [], []
    for given in inputs:
        path = tmp_path / f"{given.folder.name}.grid"
        succeed("submaps", given.folder / source, "--out", path)
        if source == "cloud.ply":  # another cloud over it
            succeed("submaps", given.folder / "other.ply", "--out", path, "--at", 1e6)
        with GridStore.open(path) as store:
            points = [load_points(store, key)["points"] for key in store.cells()]
            stored.append(given.back(np.concatenate(points)))
            changed.append([change.changed for change in store.changed_since(store.visits()[0])])
    near, far = stored
    assert len(near) == len(far) and np.abs(near - far).max() < 0.1 * MM
    assert changed[0] == changed[1] and (source != "cloud.ply" or any(changed[0]))


# --- compare ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("align", ["none", "icp", "auto"])
def test_compare_clouds(inputs: tuple[Input, Input], tmp_path: Path, align: str) -> None:
    found = []
    for given in inputs:
        out = tmp_path / f"{given.folder.name}.json"
        succeed("compare", given.folder / "other.ply", given.folder / "scan.ply", "--align", align, "--out", out)
        found.append(json.loads(out.read_text()))
    near, far = found
    assert near["icp"]["turned_deg"] > 0.5
    assert _difference(near["icp"], far["icp"], ("T_target_source",)) < 1e-5
    for part in ("overlap", "surface", "geometry"):
        assert _difference(near[part], far[part]) < 1e-6, part


def _difference(one: Any, other: Any, but: tuple[str, ...] = ()) -> float:
    """The largest difference between numbers at the same places of two JSON values."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        return max((_difference(one[name], other[name], but) for name in one if name not in but), default=0.0)
    if isinstance(one, list):
        assert len(one) == len(other)
        return max((_difference(*pair, but) for pair in zip(one, other, strict=True)), default=0.0)
    if one is None or isinstance(one, (str, bool)):
        assert one == other
        return 0.0
    return abs(float(one) - float(other))


# --- volumes ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def volumes(inputs: tuple[Input, Input], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Of the recording, at its own poses, and a store of nothing else."""
    outs = []
    for given in inputs:
        out = tmp_path_factory.mktemp("volumes") / given.folder.name
        maps = ["--voxel", 0.05, "--esdf", "--occupancy", 0.1]
        succeed("volumes", given.room, "--out", out, "--stop", 8, *maps, *DEPTH)
        outs.append(out)
    return outs[0], outs[1]


def test_meshes(inputs: tuple[Input, Input], volumes: tuple[Path, Path]) -> None:
    near, far = (read_mesh(out / "mesh.ply") for out in volumes)
    assert near is not None and far is not None and len(near.triangles) == len(far.triangles) > 1000
    assert np.abs(near.vertices - inputs[1].back(far.vertices)).max() < 0.1 * MM


def test_occupancy_maps(inputs: tuple[Input, Input], volumes: tuple[Path, Path]) -> None:
    for ending in ("bt", "ot"):
        near, far = (read_octomap(out / f"occupancy.{ending}") for out in volumes)
        one, other = near.occupied_centers()[0], inputs[1].back(far.occupied_centers()[0])
        assert len(one) == len(other) > 100 and np.abs(one - other).max() < 0.1 * MM
        assert (near.states(one) == far.states(other + UTM)).all()
    assert b"\n# origin 463000.0 5427000.0 300.0\n" in (volumes[1] / "occupancy.bt").read_bytes()[:300]


def test_maps_for_robots(volumes: tuple[Path, Path]) -> None:
    near, far = volumes
    assert (near / "map.pgm").read_bytes() == (far / "map.pgm").read_bytes()
    assert (near / "map.yaml").read_text() == (far / "map.yaml").read_text()  # in the floor's frame
    for name in ("mesh.png", "esdf.png", "occupancy.png"):
        assert (near / name).stat().st_size == pytest.approx((far / name).stat().st_size, rel=0.01), name
    facts = [json.loads((out / "volumes.json").read_text()) for out in volumes]
    T_near, T_far = (np.array(fact["T_floor_map"]) for fact in facts)
    assert np.allclose(T_near[:3, 3], transform_points(UTM[None], T_far)[0], atol=1e-6)
    assert facts[0]["esdf"]["slice_height"] == pytest.approx(facts[1]["esdf"]["slice_height"], abs=1e-4)
    assert facts[1]["origin"] == UTM.tolist() and "origin" not in facts[0]


def test_volumes_are_gone_on_with(inputs: tuple[Input, Input], volumes: tuple[Path, Path], tmp_path: Path) -> None:
    meshes = []
    for given, before in zip(inputs, volumes, strict=True):
        out = tmp_path / given.folder.name
        onto = ["--onto", before / "tsdf.npz", "--frame", "floor"]
        succeed("volumes", given.room, "--out", out, "--start", 8, *onto, *DEPTH)
        meshes.append(read_mesh(out / "mesh.ply"))
    near, far = meshes
    assert near is not None and far is not None and len(near.triangles) == len(far.triangles)
    assert np.abs(near.vertices - far.vertices).max() < 0.1 * MM  # in the floor's frame
    assert read_mesh(volumes[0] / "mesh.ply").area() < near.area()  # type: ignore[union-attr]


def test_volumes_on_a_device(inputs: tuple[Input, Input], tmp_path: Path) -> None:
    meshes = []
    for given in inputs:
        out = tmp_path / given.folder.name
        succeed("volumes", given.room, "--out", out, "--voxel", 0.1, "--stop", 2, "--device", "cpu", *DEPTH)
        meshes.append(read_mesh(out / "mesh.ply"))
    near, far = meshes
    assert near is not None and far is not None
    assert len(near.vertices) == len(far.vertices) and np.abs(near.vertices - far.vertices + UTM).max() < 0.1 * MM


@pytest.mark.parametrize("ending", ["ply", "obj", "glb"])
def test_mesh_files(inputs: tuple[Input, Input], tmp_path: Path, ending: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    found = []
    for given in inputs:
        path = tmp_path / f"{given.folder.name}.{ending}"
        wanted = ["--voxel", 0.1, "--stop", 2, "--mesh", path, *DEPTH]
        succeed("volumes", given.room, "--out", tmp_path / given.folder.name, *wanted)
        loaded = trimesh.load(path, process=False)
        scene = loaded.to_geometry() if hasattr(loaded, "to_geometry") else loaded
        vertices = np.asarray(scene.vertices, np.float64)
        if ending == "glb":  # y upwards
            vertices = vertices * [1, -1, -1]
        found.append(given.back(vertices))
    assert _farthest(*found) < 0.1 * MM


# --- encode and decode -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [("--voxel", "0.05"), ("--bits", "12")], ids=["voxel", "bits"])
@pytest.mark.parametrize("ending", ["ply", "pcd"])
def test_encode(inputs: tuple[Input, Input], tmp_path: Path, options: tuple[str, str], ending: str) -> None:
    found = []
    for given in inputs:
        stream, out = tmp_path / f"{given.folder.name}.bin", tmp_path / f"{given.folder.name}.{ending}"
        succeed("encode", given.folder / "other.ply", stream, *options)
        succeed("decode", stream, out)
        points = given.back(read_point_cloud(out).points)
        original = given.back(read_point_cloud(given.folder / "other.ply").points)
        voxel = 0.05 if options[0] == "--voxel" else float(np.ptp(original, axis=0).max()) / 4095
        assert _farthest(original, points) <= 1.001 * np.sqrt(3) / 2 * voxel
        found.append(points)
    if options[0] == "--voxel":  # UTM is a whole number of these voxels away
        assert _farthest(*found) < 0.1 * MM


def test_a_box_of_a_stream(inputs: tuple[Input, Input], tmp_path: Path) -> None:
    found = []
    for given in inputs:
        stream, out = tmp_path / f"{given.folder.name}.bin", tmp_path / f"{given.folder.name}.ply"
        succeed("encode", given.folder / "other.ply", stream, "--voxel", 0.05, "--slices", 4)
        middle = np.median(given.back(read_point_cloud(given.folder / "other.ply").points), axis=0).round(1) + 0.013
        corners = np.concatenate([middle - 3, middle + 3]) + np.tile(given.offset, 2)
        succeed("decode", stream, out, "--box", " ".join(f"{value:.3f}" for value in corners))
        found.append(given.back(read_point_cloud(out).points))
        assert np.abs(found[-1] - middle).max() <= 3 + 0.05
    assert len(found[0]) == len(found[1]) > 100 and _farthest(*found) < 0.1 * MM


# --- runs ------------------------------------------------------------------------------------------------------------


@pytest.mark.long("runs, scores and merges a recording at two places of the world")
def test_runs_do_not_know_where_the_world_is(inputs: tuple[Input, Input], tmp_path: Path) -> None:
    """A run's world is its first camera; truth far away is compared as truth near by, and files in the world of the
    truth are found by it."""
    scores, compared = [], []
    for given in inputs:
        run = tmp_path / given.folder.name
        succeed("run", given.room, "--out", run, "--stop", 5, "--iterations", 1, "--no-eval",
                "--set", "masks.source=none", "--set", "mapping.first_frame_iterations=2")  # fmt: skip
        succeed("eval", run, "--no-lpips", "--every", 4)
        scores.append(json.loads((run / "metrics.json").read_text()))
        mesh, out = tmp_path / f"{given.folder.name}.ply", tmp_path / f"{given.folder.name}.json"
        succeed("volumes", given.room, "--out", run.with_suffix(".volumes"), "--stop", 5, "--mesh", mesh, *DEPTH)
        succeed("compare", run, mesh, "--align", "truth", "--out", out)
        compared.append(json.loads(out.read_text()))
    near, far = scores
    assert near["trajectory"]["ate_rmse_m"] < 0.02
    assert _difference(near["trajectory"], far["trajectory"]) < 1e-6
    assert _difference(near["images"]["held_out"], far["images"]["held_out"]) < 1e-6
    trajectories = [read_tum(tmp_path / given.folder.name / "trajectory.txt").T_world_camera for given in inputs]
    assert np.array_equal(*trajectories)
    one, other = compared
    assert one["overlap"]["a_on_b"]["fitness"] > 0.5
    assert _difference(one["overlap"], other["overlap"]) < 2e-3 and _difference(one["surface"], other["surface"]) < 1e-4


# --- what cannot be where it is --------------------------------------------------------------------------------------


def test_single_precision_far_away_is_named(
    inputs: tuple[Input, Input], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    points = read_point_cloud(inputs[1].folder / "other.ply").points
    write_point_cloud(tmp_path / "rounded.ply", points.astype(np.float32), {})
    caplog.clear()
    read_point_cloud(tmp_path / "rounded.ply")
    assert "reach 54270" in caplog.text and "steps of 0.5 there" in caplog.text
    caplog.clear()
    read_point_cloud(inputs[1].folder / "other.ply")
    read_point_cloud(inputs[0].folder / "other.ply")
    assert not caplog.text


def test_gaussians_are_not_taken_far_away(tmp_path: Path) -> None:
    names = ("x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
    rows = np.zeros(40, [(name, "f8") for name in names])
    for axis, values in zip("xyz", np.random.default_rng(0).normal(size=(3, 40)), strict=True):
        rows[axis] = values
    rows["rot_0"] = 1
    write_ply(tmp_path / "near.ply", {"vertex": rows})
    for axis, offset in zip("xyz", UTM, strict=True):
        rows[axis] += offset
    write_ply(tmp_path / "far.ply", {"vertex": rows})
    succeed("export", tmp_path / "near.ply", "--out", tmp_path / "near.spz")
    refuse(
        ggslam("export", tmp_path / "far.ply", "--out", tmp_path / "far.spz"),
        "far.ply", "542700", "steps of 0.5 m", "subtract an offset",
    )  # fmt: skip
    moved = ggslam("edit", tmp_path / "near.ply", "--move", "all", "463000 5427000 300", "--out", tmp_path / "at.ply")
    refuse(moved, "single precision", "steps of 0.5 m", "large offsets")


def test_a_map_of_the_field(shared_data: Path, tmp_path: Path) -> None:
    """KITTI's scans in a map at UTM coordinates, against the same map near zero."""
    field, found = shared_data / "field" / "maps" / "utm_map", []
    points, poses = read_point_cloud(field / "map.ply").points, read_tum(field / "trajectory.txt")
    for name, offset in (("near", -UTM), ("far", np.zeros(3))):
        given, out = tmp_path / name, tmp_path / f"{name}.out"
        shutil.copytree(field / "scans", given / "scans")
        write_point_cloud(given / "map.ply", points + offset, {})
        write_tum(given / "trajectory.txt", poses.timestamps, _moved(poses.T_world_camera, offset))
        options = ["--columns", 3, "--full-map", "--start-pose", "given"]
        succeed("localize", given / "map.ply", given, *options, "--out", out)
        located, true = (read_tum(f / "trajectory.txt").T_world_camera[:, :3, 3] for f in (out, given))
        found.append(located - true)
        assert np.linalg.norm(found[-1], axis=1).max() < 0.006
    assert np.abs(found[0] - found[1]).max() < 0.1 * MM
