# SPDX-License-Identifier: Apache-2.0
"""Contents made of volumes: the floor as robots meet it, the surface in parts, a slice through the distance field."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from ggslam.driving.bands import HeightLayers, floor_plane
from ggslam.driving.robot import Robot
from ggslam.jobs.serve.channels import FLOOR, MAP
from ggslam.jobs.serve.tiles import Tile, rows_by_key, tile_of
from ggslam.jobs.volumes.robot_maps import FloorMapTuning
from ggslam.messages.contents import Grid, Mesh, Points
from ggslam.scene.poses import translation
from ggslam.system.tuning import Tuning
from ggslam.volumes.cell_grid import CellGrid
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.mesh import Mesh as SurfaceMesh
from ggslam.volumes.mesh import extract_mesh
from ggslam.volumes.slices import plane_at_height, slice_field
from ggslam.volumes.tsdf import TsdfMap


class VolumeContentsTuning(Tuning):
    """How volumes are published."""

    min_piece_triangles = 50
    """Pieces of the mesh with fewer triangles are left out."""
    most_triangles = 150_000
    """Most triangles of the mesh, whose vertices are united in larger cells until it has no more."""
    part_triangles = 5000
    """Most triangles of one message."""
    slice_points = 30_000
    """Most points of a slice through the distance field."""
    most_cells = 4_000_000
    """Most cells of a grid."""


def layers_of(field: DistanceField, T_floor_map: np.ndarray, seen: bool) -> HeightLayers:
    """What a volume, up to date, has above the floor of T_floor_map [4, 4], which was `seen` or is guessed."""
    plane = floor_plane(field, T_floor_map)
    area = (plane.high[0] - plane.low[0]) * (plane.high[1] - plane.low[1])
    cell = max(FloorMapTuning.cell_m, field.voxel, math.sqrt(area / VolumeContentsTuning.most_cells))
    return HeightLayers(field, plane, cell, seen)


def grid_of(layers: HeightLayers, robot: Robot) -> Grid:
    """What a robot meets, in the floor's frame."""
    band = layers.band(robot)
    cells = np.where(band.occupied, 100, np.where(band.free, 0, -1)).astype(np.int8)[::-1]
    x, y = band.plane.low
    return Grid(FLOOR, translation(np.array([x, y, 0.0])), band.resolution, np.ascontiguousarray(cells))


def slice_of(field: DistanceField, up: np.ndarray, poses: np.ndarray) -> Points:
    """The distance field at the height along `up` [3] of the cameras T_map_camera [N, 4, 4]: where it is known, with
    `distance` in metres, negative behind surfaces."""
    height = float(np.median((poses[:, :3, 3] - field.origin) @ up))
    plane = plane_at_height(field, up, height)
    area = (plane.high[0] - plane.low[0]) * (plane.high[1] - plane.low[1])
    cell = max(FloorMapTuning.cell_m, math.sqrt(area / VolumeContentsTuning.slice_points))
    cut = slice_field(field, plane, cell)
    places = CellGrid.over(plane, cell).places()
    return Points(MAP, places[cut.known].astype(np.float32), None, {"distance": cut.distance[cut.known]})


def published_mesh(tsdf: TsdfMap) -> SurfaceMesh:
    """The surface without small pieces, and with no more triangles than are sent."""
    mesh = extract_mesh(tsdf, min_triangles=VolumeContentsTuning.min_piece_triangles)
    cell = tsdf.settings.voxel
    while len(mesh.triangles) > VolumeContentsTuning.most_triangles:
        cell *= 2
        mesh = _coarser(mesh, cell)
    return mesh


def triangle_middles(mesh: SurfaceMesh) -> np.ndarray:
    """Of each triangle, float32 [F, 3], metres."""
    middles: np.ndarray = mesh.vertices[mesh.triangles].mean(axis=1)
    return middles.astype(np.float32)


def tiles_of_mesh(mesh: SurfaceMesh) -> dict[Tile, np.ndarray]:
    """Rows of triangles by the tile that their middle lies in."""
    return rows_by_key(tile_of(triangle_middles(mesh)))


def mesh_parts_of_tile(mesh: SurfaceMesh, tile: Tile, rows: np.ndarray) -> Iterator[Mesh]:
    """The triangles [N] of a tile in parts, which are named after it and numbered."""
    name, count = ",".join(map(str, tile)), -(-len(rows) // VolumeContentsTuning.part_triangles)
    for number, piece in enumerate(np.array_split(rows, count) if count else ()):
        used, triangles = np.unique(mesh.triangles[piece], return_inverse=True)
        shape = triangles.reshape(-1, 3).astype(np.int32)
        yield Mesh(MAP, mesh.vertices[used].astype(np.float32), shape, mesh.colors[used], f"{name}/{number}")


def gone_part(name: str) -> Mesh:
    """A part of a mesh that is not there any more."""
    return Mesh(MAP, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8), name)


def _coarser(mesh: SurfaceMesh, cell: float) -> SurfaceMesh:
    """The vertices of each cell as one, in their middle, and the triangles that are left."""
    _, first, owner, count = np.unique(
        np.floor(mesh.vertices / cell).astype(np.int64), axis=0, return_index=True, return_inverse=True,
        return_counts=True,
    )  # fmt: skip
    owner = owner.reshape(-1)
    sums = [np.bincount(owner, mesh.vertices[:, axis], len(first)) for axis in range(3)]
    vertices = (np.stack(sums, axis=1) / count[:, None]).astype(np.float32)
    triangles = owner[mesh.triangles].astype(np.int32)
    a, b, c = triangles.T
    kept = np.unique(triangles[(a != b) & (b != c) & (a != c)], axis=0)
    return SurfaceMesh(vertices, mesh.normals[first], mesh.colors[first], mesh.labels[first], kept)
