# SPDX-License-Identifier: Apache-2.0
"""The surface of a TSDF as a mesh (W. Lorensen and H. Cline, "Marching Cubes", 1987), with colours and objects."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ggslam.abi.core import MeshArrays
from ggslam.formats.triangle_mesh import TriangleMesh, majority_labels
from ggslam.native.loader import load_library
from ggslam.scene.origin import stored_positions
from ggslam.scene.poses import transform_points
from ggslam.volumes.surface_cells import surface_cells
from ggslam.volumes.tsdf import TsdfMap


@dataclass(frozen=True)
class Mesh:
    """Triangles whose vertices are shared.

    Attributes:
        vertices: float32 [V, 3], metres; float64 where the map's origin is not the world's (`scene.origin`).
        normals: float32 [V, 3], unit, towards free space.
        colors: uint8 [V, 3].
        labels: uint16 [V], object; 0: none.
        triangles: int32 [F, 3], rows of vertices, counter-clockwise seen from free space.
    """

    vertices: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    labels: np.ndarray
    triangles: np.ndarray

    def triangle_labels(self) -> np.ndarray:
        """Object of each triangle, uint16 [F]: that of at least two of its vertices, else of the first."""
        return majority_labels(self.labels, self.triangles)

    def objects(self) -> list[int]:
        """The objects that have triangles, in order."""
        return [int(label) for label in np.unique(self.triangle_labels()) if label]

    def of_object(self, label: int) -> Mesh:
        """The triangles of one object (0: of none) and their vertices. Each triangle is in exactly one of these."""
        return self.part(self.triangle_labels() == label)

    def part(self, chosen: np.ndarray) -> Mesh:
        """Some of the triangles (bool [F]) and their vertices, in their order."""
        triangles = self.triangles[chosen]
        used = np.zeros(len(self.vertices), bool)
        used[triangles] = True
        number = np.cumsum(used, dtype=np.int32) - 1
        return Mesh(self.vertices[used], self.normals[used], self.colors[used], self.labels[used], number[triangles])

    def in_frame(self, T: np.ndarray) -> Mesh:
        """The mesh in another frame, T_new_old float64 [4, 4], rigid."""
        vertices = transform_points(self.vertices.astype(np.float64), T)
        normals = self.normals.astype(np.float64) @ T[:3, :3].T
        return replace(self, vertices=stored_positions(vertices), normals=normals.astype(np.float32))

    def geometry(self) -> TriangleMesh:
        """Vertices and triangles alone, for sampling and areas."""
        return TriangleMesh(self.vertices.astype(np.float64), self.triangles.astype(np.int64))


def extract_mesh(tsdf: TsdfMap, min_weight: float | None = None, min_triangles: int = 0) -> Mesh:
    """The surface where the distance changes its sign, between voxels that are all known.

    Neighbouring cells agree on their common face, so the mesh is closed but for borders with the unknown: no edge has
    more than two triangles. No triangle is without area. The order of vertices and triangles follows the map's blocks
    and does not depend on the number of threads.

    Args:
        tsdf: the map.
        min_weight: voxels of less weight (in measurements from 1 m), or never seen, count as unknown; None: see
            `TsdfSettings.least_weight`.
        min_triangles: connected pieces of fewer triangles are left out.
    """
    core, cells = load_library(), surface_cells(tsdf, min_weight)
    sizes = (ctypes.c_int64 * 2)()
    mesher = core.ggslam_mesher_create(tsdf.context.handle, cells.handle, sizes)
    try:
        vertices, normals = np.empty((2, sizes[0], 3), np.float32)
        colors, labels = np.empty((sizes[0], 3), np.uint8), np.empty(sizes[0], np.uint16)
        triangles = np.empty((sizes[1], 3), np.int32)
        arrays = (vertices, normals, colors, labels, triangles)
        pointers = MeshArrays(*(array.ctypes.data for array in arrays))
        core.ggslam_mesher_write(tsdf.context.handle, mesher, ctypes.byref(pointers))
    finally:
        core.ggslam_mesher_destroy(mesher)
    mesh = Mesh(vertices + tsdf.origin if tsdf.origin.any() else vertices, normals, colors, labels, triangles)
    return without_small_pieces(mesh, min_triangles) if min_triangles > 1 else mesh


def empty_mesh() -> Mesh:
    """A mesh of nothing."""
    none = np.zeros((0, 3), np.float32)
    return Mesh(none, none, none.astype(np.uint8), np.zeros(0, np.uint16), none.astype(np.int32))


def join_meshes(parts: list[Mesh]) -> Mesh:
    """Meshes as one: vertices that are the same bit for bit become one, with what the first has of them."""
    if not parts:
        return empty_mesh()
    vertices = np.concatenate([part.vertices for part in parts])
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=False)]
    bits = np.ascontiguousarray(vertices + 0.0).view([("", vertices.dtype)] * 3).ravel()  # + 0: -0 and 0 are the same
    _, first, number = np.unique(bits, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    rows, place = first[order], np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    normals, colors, labels = (
        np.concatenate([getattr(part, name) for part in parts])[rows] for name in ("normals", "colors", "labels")
    )
    return Mesh(vertices[rows], normals, colors, labels, place[number.reshape(-1)][np.concatenate(triangles)])


def pieces_of(mesh: Mesh) -> tuple[int, np.ndarray]:
    """How many connected pieces a mesh has, and the number of each vertex' piece, int [V]."""
    first, second, third = mesh.triangles.T
    rows, columns = np.concatenate([first, second]), np.concatenate([second, third])
    links = coo_array((np.ones(len(rows), bool), (rows, columns)), (len(mesh.vertices),) * 2)
    count, of_vertex = connected_components(links, directed=False)
    return int(count), of_vertex


def without_small_pieces(mesh: Mesh, min_triangles: int) -> Mesh:
    """A mesh without its connected pieces of fewer triangles."""
    piece = pieces_of(mesh)[1][mesh.triangles[:, 0]]
    return mesh.part(np.bincount(piece)[piece] >= min_triangles if len(piece) else np.zeros(0, bool))
