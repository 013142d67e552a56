# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes from PLY files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.errors import FormatError
from ggslam.formats.ply import read_ply

_LIST_NAMES = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class TriangleMesh:
    """Vertices float64 [V, 3] in metres (or the file's own unit) and triangles int64 [F, 3], rows of vertices,
    counter-clockwise seen from outside."""

    vertices: np.ndarray
    triangles: np.ndarray

    def area(self) -> float:
        """In squared units of the vertices."""
        return float(np.linalg.norm(self._crosses(), axis=1).sum() / 2)

    def sample(self, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Points spread evenly over the area.

        Args:
            count: how many.
            seed: of the draw.

        Returns:
            points float64 [count, 3], unit normals of their triangles [count, 3].

        Raises:
            ValueError: the mesh has no area.
        """
        normal = self._crosses()
        twice = np.linalg.norm(normal, axis=1)
        if not twice.sum() > 0:
            raise ValueError("the mesh has no area")
        rng = np.random.default_rng(seed)
        chosen = rng.choice(len(twice), count, p=twice / twice.sum())
        a, b = rng.random((2, count, 1))
        # The other half of the parallelogram folds back onto the triangle.
        a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
        first, second, third = (self.vertices[self.triangles[chosen, k]] for k in range(3))
        return first + a * (second - first) + b * (third - first), normal[chosen] / twice[chosen, None]

    def _crosses(self) -> np.ndarray:
        """Normals [F, 3], twice as long as the triangles are large."""
        first, second, third = (self.vertices[self.triangles[:, k]] for k in range(3))
        return np.cross(second - first, third - first)


def majority_labels(labels: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Label of each triangle, [F], from those of its vertices, labels [V]: that of at least two, else of the first."""
    first, second, third = labels[triangles].T
    return np.where(second == third, second, first)


def read_mesh(path: str | Path) -> TriangleMesh | None:
    """The mesh of a PLY file; None if it has no faces (it is a point cloud). Polygons are cut into fans of triangles.

    Raises:
        FormatError: missing or damaged file, no positions, faces of no or fewer than 3 vertices, a vertex that is not
            there or not finite; names file and reason.
    """
    ply = read_ply(path)
    faces = ply.elements.get("face")
    if faces is None or not len(faces):
        return None
    rows = ply.elements.get("vertex")
    if rows is None or any(name not in (rows.dtype.names or ()) for name in "xyz"):
        raise FormatError(f"{path}: faces, but no element 'vertex' with x y z")
    vertices = np.stack([rows[name] for name in "xyz"], 1).astype(np.float64)
    if not np.isfinite(vertices).all():
        row = int(np.argmin(np.isfinite(vertices).all(1)))
        raise FormatError(f"{path}: vertex {row} is {vertices[row].tolist()}, expected finite numbers")
    name = next((n for n in _LIST_NAMES if n in (faces.dtype.names or ())), None)
    if name is None:
        raise FormatError(f"{path}: element 'face' has no list {' or '.join(_LIST_NAMES)}")
    triangles = _triangles(path, faces[name])
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise FormatError(
            f"{path}: faces name vertices {triangles.min()} to {triangles.max()}; there are {len(vertices)}"
        )
    return TriangleMesh(vertices, triangles)


def _triangles(path: str | Path, lists: np.ndarray) -> np.ndarray:
    """int64 [F, 3] of an array [n, k] or of n arrays."""
    groups = [lists] if lists.ndim == 2 else []
    if lists.ndim == 1:
        sizes = np.array([len(corners) for corners in lists])
        groups = [np.stack(list(lists[sizes == size])) for size in np.unique(sizes)]
    out = []
    for group in groups:
        if group.shape[1] < 3:
            raise FormatError(f"{path}: a face of {group.shape[1]} vertices, expected at least 3")
        out += [group[:, [0, i, i + 1]] for i in range(1, group.shape[1] - 1)]
    return np.concatenate(out).astype(np.int64)
