# SPDX-License-Identifier: Apache-2.0
"""Mesh files."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import FormatError, MissingDependency, RunFolderError
from ggslam.formats.mesh_files import check_mesh_path, write_mesh
from ggslam.formats.ply import read_ply
from ggslam.formats.triangle_mesh import read_mesh


def example(size: int = 12) -> dict[str, np.ndarray]:
    """A wavy square of `size` x `size` vertices in two objects and a part without."""
    v, u = np.mgrid[:size, :size].astype(np.float32)
    vertices = np.stack([u, v, np.sin(u)], -1).reshape(-1, 3) * 0.1
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + size], 1)
    upper = np.stack([corner + 1, corner + size + 1, corner + size], 1)
    normals = np.stack([-np.cos(u), 0 * u, np.ones_like(u)], -1).reshape(-1, 3)
    colors = np.random.default_rng(0).integers(0, 256, (size * size, 3), np.uint8)
    labels = np.select([u < 4, u > 8], [3, 500], 0).ravel().astype(np.uint16)
    return {
        "vertices": vertices, "triangles": np.concatenate([lower, upper]).astype(np.int32),
        "normals": normals / np.linalg.norm(normals, axis=1, keepdims=True), "colors": colors, "labels": labels,
    }  # fmt: skip


def corner_rows(vertices: np.ndarray, colors: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Positions and colours of all triangles' corners, in an order that does not depend on how they are stored."""
    rows = np.concatenate([vertices[triangles], colors[triangles] / 255], 2).reshape(-1, 18).round(4)
    return rows[np.lexsort(rows.T)]


def test_ply_is_read_back(tmp_path: Path) -> None:
    mesh = example()
    write_mesh(tmp_path / "m.ply", **mesh)
    back = read_mesh(tmp_path / "m.ply")
    assert back is not None
    assert np.array_equal(back.vertices.astype(np.float32), mesh["vertices"])
    assert np.array_equal(back.triangles, mesh["triangles"])
    rows = read_ply(tmp_path / "m.ply").elements["vertex"]
    assert np.array_equal(np.stack([rows[n] for n in ("red", "green", "blue")], 1), mesh["colors"])
    assert np.allclose(np.stack([rows[n] for n in ("nx", "ny", "nz")], 1), mesh["normals"])
    assert rows["object_id"].dtype == np.uint16 and np.array_equal(rows["object_id"], mesh["labels"])


def test_ply_of_bare_and_empty_meshes(tmp_path: Path) -> None:
    mesh = example()
    write_mesh(tmp_path / "bare.ply", mesh["vertices"], mesh["triangles"])
    assert read_ply(tmp_path / "bare.ply").elements["vertex"].dtype.names == ("x", "y", "z")
    write_mesh(tmp_path / "empty.ply", np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    assert read_mesh(tmp_path / "empty.ply") is None and len(read_ply(tmp_path / "empty.ply").elements["vertex"]) == 0


def test_ply_is_read_by_open3d(tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d")
    mesh = example()
    write_mesh(tmp_path / "m.ply", **mesh)
    back = open3d.io.read_triangle_mesh(str(tmp_path / "m.ply"))
    assert np.allclose(np.asarray(back.vertices), mesh["vertices"])
    assert np.array_equal(np.asarray(back.triangles), mesh["triangles"])
    assert np.allclose(np.asarray(back.vertex_colors) * 255, mesh["colors"], atol=0.01)
    assert np.allclose(np.asarray(back.vertex_normals), mesh["normals"], atol=1e-6)


@pytest.mark.parametrize("ending", [".ply", ".obj", ".glb", ".OBJ"])
def test_trimesh_reads_all(tmp_path: Path, ending: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = example()
    write_mesh(tmp_path / f"m{ending}", **mesh)
    loaded = trimesh.load_scene(tmp_path / f"m{ending}", process=False)
    parts = list(loaded.geometry.values())
    rows = np.concatenate([corner_rows(p.vertices, p.visual.vertex_colors[:, :3], p.faces) for p in parts])
    expected = corner_rows(mesh["vertices"], mesh["colors"], mesh["triangles"])
    assert np.allclose(rows[np.lexsort(rows.T)], expected, atol=2e-3)
    normals = np.concatenate([p.vertex_normals[p.faces].reshape(-1, 3) for p in parts])
    expected_normals = mesh["normals"][mesh["triangles"]].reshape(-1, 3)
    assert np.allclose(np.sort(normals[:, 0]), np.sort(expected_normals[:, 0]), atol=1e-3)


def test_glb_has_a_node_for_each_object(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = example()
    write_mesh(tmp_path / "m.glb", **mesh, names={3: "cup", 9: "absent"})
    scene = trimesh.load_scene(tmp_path / "m.glb")
    assert set(scene.graph.nodes_geometry) == {"3 cup", "object 500", "unlabelled"}
    assert scene.geometry["3 cup"].vertices[:, 0].max() < 0.55
    assert scene.geometry["object 500"].vertices[:, 0].min() > 0.75
    assert sum(len(g.faces) for g in scene.geometry.values()) == len(mesh["triangles"])
    up = -mesh["vertices"][:, 1]  # glTF's y
    assert np.allclose(scene.bounds[:, 1], [up.min(), up.max()], atol=1e-5)
    del mesh["labels"]
    write_mesh(tmp_path / "m.glb", **mesh)
    assert len(trimesh.load_scene(tmp_path / "m.glb").geometry) == 1


def test_what_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = example()
    with pytest.raises(FormatError, match=r"m\.stl.*\.ply, \.obj, \.glb"):
        write_mesh(tmp_path / "m.stl", **mesh)
    with pytest.raises(RunFolderError, match="m.ply"):
        write_mesh(tmp_path / "none" / "m.ply", **mesh)
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(MissingDependency, match=r"m\.glb.*ggslam\[mesh\]"):
        check_mesh_path(tmp_path / "m.glb")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", [".obj", ".glb"])
def test_empty_meshes_are_refused(tmp_path: Path, ending: str) -> None:
    pytest.importorskip("trimesh")
    with pytest.raises(FormatError, match="no triangles"):
        write_mesh(tmp_path / f"m{ending}", np.empty((0, 3), np.float32), np.empty((0, 3), np.int32))
    assert list(tmp_path.iterdir()) == []
