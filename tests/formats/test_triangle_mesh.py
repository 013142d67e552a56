# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes: sampling, and what files are taken for one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.formats.triangle_mesh import TriangleMesh, read_mesh

HEADER = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
VERTICES = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n0.5 0.5 1\n"


def written(folder: Path, faces: str, name: str = "vertex_indices") -> Path:
    count = len(faces.splitlines())
    path = folder / "mesh.ply"
    path.write_text(f"{HEADER}element face {count}\nproperty list uchar int {name}\nend_header\n{VERTICES}{faces}")
    return path


@pytest.mark.parametrize("name", ["vertex_indices", "vertex_index"])
def test_polygons_become_fans(tmp_path: Path, name: str) -> None:
    mesh = read_mesh(written(tmp_path, "4 0 1 2 3\n3 0 1 4\n", name))
    assert mesh is not None and mesh.vertices.shape == (5, 3)
    assert sorted(map(tuple, mesh.triangles.tolist())) == [(0, 1, 2), (0, 1, 4), (0, 2, 3)]
    assert mesh.area() == pytest.approx(1 + np.sqrt(1.25) / 2)


def test_a_cloud_is_no_mesh(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    path.write_text(f"{HEADER}end_header\n{VERTICES}")
    assert read_mesh(path) is None


def test_impossible_faces_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="0 to 5.* 5"):
        read_mesh(written(tmp_path, "3 0 1 5\n"))
    with pytest.raises(FormatError, match=r"\b2\b.*\b3\b"):
        read_mesh(written(tmp_path, "2 0 1\n"))
    with pytest.raises(FormatError, match="'face'"):
        read_mesh(written(tmp_path, "3 0 1 2\n", "corners"))


def test_meshes_are_sampled_evenly_by_area() -> None:
    vertices = np.array([[0, 0, 0], [3, 0, 0], [3, 1, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1]], float)
    triangles = np.array([[0, 1, 2], [0, 2, 3], [0, 4, 5], [0, 5, 3]])  # a floor of 3 m2, a wall of 1 m2
    mesh = TriangleMesh(vertices, triangles)
    assert mesh.area() == pytest.approx(4)
    points, normals = mesh.sample(40_000, seed=5)
    floor = np.abs(normals[:, 2]) > 0.5
    assert floor.mean() == pytest.approx(0.75, abs=0.01)
    assert np.abs(points[floor, 2]).max() == 0 and np.abs(points[~floor, 0]).max() == 0
    counts, *_ = np.histogram2d(points[floor, 0], points[floor, 1], bins=(6, 2), range=((0, 3), (0, 1)))
    assert counts.min() > 0.9 * counts.mean() and counts.sum() == floor.sum()
    assert (mesh.sample(100, seed=5)[0] == mesh.sample(100, seed=5)[0]).all()
    with pytest.raises(ValueError, match="no area"):
        TriangleMesh(vertices, np.array([[0, 0, 0]])).sample(10)
