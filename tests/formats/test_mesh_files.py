# SPDX-License-Identifier: Apache-2.0
"""Mesh files."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ggslam.errors import FormatError, MissingDependency, RunFolderError
from ggslam.formats.mesh_files import GLTF_AXES, GLTF_FROM_Z_UP, check_mesh_path, write_mesh
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
    return rows[np.lexsort(rows.T[::-1])]  # by positions first: colours differ a little


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


def colors_of(part: Any) -> np.ndarray:
    """Colours 0 to 255 at the vertices of a mesh of trimesh's."""
    found = getattr(part.visual, "vertex_attributes", {}).get("color")
    return np.asarray(part.visual.vertex_colors)[:, :3] if found is None else 255 * (found[:, :3] / 65535)


@pytest.mark.parametrize("ending", [".ply", ".obj", ".glb", ".OBJ"])
def test_trimesh_reads_all(tmp_path: Path, ending: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = example()
    write_mesh(tmp_path / f"m{ending}", **mesh)
    loaded = trimesh.load_scene(tmp_path / f"m{ending}", process=False)
    parts = list(loaded.geometry.values())
    colors = mesh["colors"]
    if ending == ".glb":  # numbers of glTF are linear light
        light = colors / 255
        colors = 255 * np.where(light <= 0.04045, light / 12.92, ((light + 0.055) / 1.055) ** 2.4)
    rows = np.concatenate([corner_rows(p.vertices, colors_of(p), p.faces) for p in parts])
    expected = corner_rows(mesh["vertices"], colors, mesh["triangles"])
    assert np.allclose(rows[np.lexsort(rows.T[::-1])], expected, atol=2e-3)
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


def glb_parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """JSON and binary part of a GLB file."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def test_colours_of_glb_are_linear_light(tmp_path: Path) -> None:
    """All 256 numbers of sRGB come back by the curve of IEC 61966-2-1, a hundredth of a grey value away at most; in 8
    bits of linear light the dark ones would be 6 away, written as sRGB the middle ones 73."""
    pytest.importorskip("trimesh")
    mesh = example(16)
    del mesh["labels"]
    grey = np.arange(256, dtype=np.uint8)
    mesh["colors"] = np.stack([grey, grey[::-1], np.roll(grey, 7)], 1)
    write_mesh(tmp_path / "m.glb", **mesh)
    gltf, binary = glb_parts(tmp_path / "m.glb")
    (primitive,) = gltf["meshes"][0]["primitives"]
    accessor = gltf["accessors"][primitive["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    view = gltf["bufferViews"][accessor["bufferView"]]
    stored = np.frombuffer(binary, "<u2", 4 * accessor["count"], view.get("byteOffset", 0)).reshape(-1, 4)
    light = stored[:, :3] / 65535
    shown = 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    assert np.abs(shown - mesh["colors"]).max() < 0.03 and (stored[:, 3] == 65535).all()
    (material,) = gltf["materials"]
    assert primitive["material"] == 0 and "KHR_materials_unlit" in material["extensions"]
    assert gltf["extensionsUsed"] == ["KHR_materials_unlit"] and "extensionsRequired" not in gltf
    surface = material["pbrMetallicRoughness"]
    assert (surface["metallicFactor"], surface["roughnessFactor"]) == (0, 1)
    assert surface["baseColorFactor"] == [1, 1, 1, 1] and not material.get("doubleSided", False)


def test_glb_of_a_mesh_with_z_up(tmp_path: Path) -> None:
    """z of the mesh is y of glTF, and nothing is mirrored."""
    trimesh = pytest.importorskip("trimesh")
    mesh = example()
    write_mesh(tmp_path / "m.glb", **mesh, z_up=True)
    loaded = trimesh.load_scene(tmp_path / "m.glb", process=False).to_geometry()
    found, wanted = loaded.vertices, mesh["vertices"][:, [0, 2, 1]] * [1, 1, -1]
    assert np.abs(found.min(0) - wanted.min(0)).max() < 1e-6 and np.abs(found.max(0) - wanted.max(0)).max() < 1e-6
    assert np.linalg.det(GLTF_FROM_Z_UP) == np.linalg.det(GLTF_AXES) == pytest.approx(1)
