# SPDX-License-Identifier: Apache-2.0
"""Clouds and meshes of one run, exported by the command line and read by others: as the formats are described, by
open3d, trimesh and plyfile where they are installed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from command_line import succeed
from mesh_readers import Mesh, from_glb, from_obj, from_ply
from scipy.spatial import cKDTree
from splat_maps import pcd_rows, ply_comments, ply_elements, stack

from ggslam.runs.folder import RunFolder
from ggslam.sequences import open_sequence

VOXEL = 0.03
COLORS = ("red", "green", "blue")


@pytest.fixture(scope="module")
def measured(room: Path, room_run: RunFolder) -> np.ndarray:
    """Points that the depth camera saw, in the run's world."""
    sequence, clouds = open_sequence(room), []
    camera = sequence.camera
    for index, T in room_run.keyframes().poses().items():
        depth = sequence.frame(index).depth
        row, column = (values[::23] for values in np.nonzero(depth > 0))
        z = depth[row, column].astype(float)
        points = np.stack([(column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z, z], 1)
        clouds.append(points @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(clouds)


@pytest.fixture(scope="module")
def points(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("points")
    succeed("export", room_run.path, "--format", "points", "--voxel", VOXEL, "--out", out)
    return out


@pytest.fixture(scope="module")
def pcd(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("pcd") / "cloud.pcd"
    succeed("export", room_run.path, "--voxel", VOXEL, "--out", out)
    return out


def own_cloud(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, colours, object ids."""
    if path.suffix == ".pcd":
        rows = pcd_rows(path)
        packed = rows["rgb"].view("<u4")
        colors = np.stack([packed >> shift & 255 for shift in (16, 8, 0)], 1)
        return stack(rows, *"xyz"), colors, rows["object_id"]
    rows = ply_elements(path)["vertex"]
    return stack(rows, *"xyz"), stack(rows, *COLORS), rows["object_id"]


def open3d_module() -> ModuleType:
    reason = "open3d cannot be imported (extra [conformance], and the library libusb-1.0)"
    return pytest.importorskip("open3d", reason=reason, exc_type=ImportError)


def by_open3d(path: Path) -> tuple[np.ndarray, np.ndarray]:
    open3d = open3d_module()
    cloud = open3d.io.read_point_cloud(str(path))
    return np.asarray(cloud.points), np.rint(255 * np.asarray(cloud.colors))


def by_trimesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed (extra [mesh])")
    cloud = trimesh.load(path, process=False)
    return np.asarray(cloud.vertices), np.asarray(cloud.visual.vertex_colors)[:, :3]


def by_plyfile(path: Path) -> tuple[np.ndarray, np.ndarray]:
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed (its licence is GPL: in no extra)")
    rows = plyfile.PlyData.read(str(path))["vertex"].data
    return stack(rows, *"xyz"), stack(rows, *COLORS)


def test_points_lie_on_what_was_seen_and_carry_its_objects(
    points: Path, measured: np.ndarray, room_run: RunFolder
) -> None:
    positions, colors, ids = own_cloud(points / "points.ply")
    assert len(positions) > 2000 and colors.std() > 20
    far = cKDTree(positions).query(measured)[0]
    assert np.median(far) < VOXEL and (far < 3 * VOXEL).mean() > 0.9
    gaussians = room_run.gaussians()
    nearest = cKDTree(gaussians.means.numpy()).query(positions)[1]
    assert (gaussians.object_id.numpy()[nearest] == ids).mean() > 0.8
    assert set(ids) <= {0, *room_run.object_table().ids()}


def test_metres_are_in_the_cells_of_the_grid(points: Path) -> None:
    metric, colors, ids = own_cloud(points / "points.ply")
    grid, same_colors, same_ids = own_cloud(points / "points_grid.ply")
    np.testing.assert_array_equal(grid, np.rint(grid))
    assert grid.min() == 0 and len(np.unique(grid, axis=0)) == len(grid)
    words = dict(line.split(maxsplit=1) for line in ply_comments(points / "points_grid.ply"))
    origin, size = np.array(words["origin"].split(), float), float(words["voxel_size"])
    assert size == VOXEL
    within = (metric - origin) / size - grid
    assert np.abs(within).max() < 0.5 and within.std() > 0.1  # where the surface is in a cell, not the cell's middle
    np.testing.assert_array_equal(colors, same_colors)
    np.testing.assert_array_equal(ids, same_ids)


def test_pcd_is_the_same_cloud(points: Path, pcd: Path) -> None:
    ply, cloud = own_cloud(points / "points.ply"), own_cloud(pcd)
    rows = cKDTree(cloud[0]).query(ply[0])[1]
    assert len(cloud[0]) == len(ply[0]) == len(np.unique(rows))
    np.testing.assert_allclose(cloud[0][rows], ply[0], atol=1e-6)
    assert np.abs(cloud[1][rows] - ply[1]).max() <= 1
    assert (cloud[2][rows] == ply[2]).mean() > 0.999


READERS = (by_open3d, by_trimesh, by_plyfile)
CLOUDS = [(by_open3d, "cloud.pcd"), *((r, name) for r in READERS for name in ("points.ply", "points_grid.ply"))]


@pytest.mark.parametrize(("reader", "name"), CLOUDS)
def test_others_read_the_same_points(
    reader: Callable[[Path], tuple[np.ndarray, np.ndarray]], name: str, points: Path, pcd: Path
) -> None:
    path = pcd if name == pcd.name else points / name
    found, colors = reader(path)
    positions, own_colors, _ = own_cloud(path)
    np.testing.assert_allclose(found, positions, atol=1e-6)
    np.testing.assert_array_equal(colors, own_colors)


@pytest.fixture(scope="module")
def meshes(room_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    pytest.importorskip("trimesh", reason="trimesh is not installed (extra [mesh]; it writes OBJ and GLB)")
    folder = tmp_path_factory.mktemp("meshes")
    for name in ("room.ply", "room.obj", "room.glb"):
        succeed("export", room_run.path, "--format", "mesh", "--voxel", 0.06, "--out", folder / name)
    return {path.suffix[1:]: path for path in folder.iterdir()}


def corners(mesh: Mesh) -> np.ndarray:
    """Positions and colours of the corners of all triangles [F, 18], in an order that does not depend on the file."""
    rows = np.concatenate([mesh.vertices[mesh.triangles], mesh.colors[mesh.triangles] / 255], 2).reshape(-1, 18)
    return rows[np.lexsort(rows.round(4).T)]


def test_meshes_of_all_kinds_are_the_same(meshes: dict[str, Path], measured: np.ndarray) -> None:
    ply, obj, glb = from_ply(meshes["ply"]), from_obj(meshes["obj"]), from_glb(meshes["glb"])
    assert len(ply.triangles) > 2000
    far = cKDTree(ply.vertices).query(measured)[0]
    assert (far < 0.12).mean() > 0.9
    assert np.abs(corners(obj) - corners(ply)).max() < 0.003  # eight digits; colours in steps of 1/255
    upright = Mesh(glb.vertices * [1, -1, -1], glb.triangles, glb.colors, glb.normals, glb.names)
    assert np.abs(corners(upright) - corners(ply)).max() < 1e-4  # metres, and a fortieth of a grey value
    for mesh in (ply, obj, glb):
        sides = mesh.vertices[mesh.triangles]
        faces = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
        seen = mesh.normals[mesh.triangles].mean(1)
        assert ((faces * seen).sum(1) > 0).mean() > 0.95  # triangles face where their normals point


def test_objects_are_nodes_of_a_glb_and_numbers_in_a_ply(meshes: dict[str, Path], room_run: RunFolder) -> None:
    table = room_run.object_table()
    known = {f"{record.id} {record.name}": record.id for record in table.objects} | {"unlabelled": 0}
    ply, glb = from_ply(meshes["ply"]), from_glb(meshes["glb"])
    assert set(glb.names) <= set(known) and len(set(glb.names)) > 8
    ids = ply_elements(meshes["ply"], lists=3)["vertex"]["object_id"]
    rows = cKDTree(ply.vertices).query(glb.vertices * [1, -1, -1])[1]
    assert (ids[rows] == [known[name] for name in glb.names]).mean() > 0.85  # triangles belong to one, corners to two


def test_trimesh_and_open3d_see_these_meshes(meshes: dict[str, Path]) -> None:
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed (extra [mesh])")
    for kind, read in (("ply", from_ply), ("obj", from_obj), ("glb", from_glb)):
        own, scene = read(meshes[kind]), trimesh.load_scene(meshes[kind], process=False)
        theirs = scene.to_mesh()
        assert len(theirs.faces) == len(own.triangles)
        np.testing.assert_allclose(theirs.bounds, [own.vertices.min(0), own.vertices.max(0)], atol=1e-5)
    open3d = open3d_module()
    own, theirs = from_ply(meshes["ply"]), open3d.io.read_triangle_mesh(str(meshes["ply"]))
    np.testing.assert_allclose(np.asarray(theirs.vertices), own.vertices, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(theirs.triangles), own.triangles)
    np.testing.assert_allclose(np.asarray(theirs.vertex_normals), own.normals, atol=1e-6)
