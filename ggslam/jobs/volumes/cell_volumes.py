# SPDX-License-Identifier: Apache-2.0
"""One cell's volumes: what a worker does. Results depend on what goes in and nothing else.

A TSDF's block belongs to the cell that its middle lies in, a cube of marching cubes to the cell of its block. Cells
that are fused from the same views have the blocks that fusing everything at once gives, and with the blocks around them
the same triangles and distances.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np

from ggslam.geometry.frustums import Frustums, depth_reach
from ggslam.jobs.submaps.visit_records import recording_of
from ggslam.jobs.tasks.processors import own_threads
from ggslam.native.loader import NativeContext
from ggslam.scene.arrays import arrays_of, arrays_to_bytes
from ggslam.scene.poses import inverse
from ggslam.submaps.cell_keys import CellKey, Grid
from ggslam.system.tuning import Tuning
from ggslam.volumes.esdf import DistanceField, FieldSettings
from ggslam.volumes.mesh import Mesh, extract_mesh
from ggslam.volumes.settings import TsdfSettings
from ggslam.volumes.tsdf import SIDE, TsdfMap
from ggslam.volumes.tsdf_file import tsdf_of_arrays, tsdf_to_bytes


class CellVolumeTuning(Tuning):
    """Which blocks of a cell a frame reaches."""

    tiles = (6, 8)
    """Rows and columns of image parts; each reaches as deep as it measured."""
    far_blocks = 1 << 20
    """Blocks from the origin, along axes that the grid does not span."""


@dataclass(frozen=True)
class CellBlocks:
    """The blocks of a cell: from `low` to `high`, coordinates of blocks of `edge` metres."""

    low: tuple[int, int, int]
    high: tuple[int, int, int]
    edge: float

    @staticmethod
    def of(grid: Grid, key: CellKey, voxel: float) -> CellBlocks:
        """Those whose middles lie in a cell."""
        edge = SIDE * voxel
        ends = [np.ceil((np.array(key) + side) * grid.spacing / edge - 0.5) for side in (-0.5, 0.5)]
        low = np.where(grid.spans, ends[0], -CellVolumeTuning.far_blocks).astype(int).tolist()
        high = np.where(grid.spans, ends[1] - 1, CellVolumeTuning.far_blocks).astype(int).tolist()
        return CellBlocks((low[0], low[1], low[2]), (high[0], high[1], high[2]), edge)

    def around(self, blocks: int) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest coordinates of its blocks and so many around them."""
        return np.array(self.low) - blocks, np.array(self.high) + blocks

    def own(self, coordinates: np.ndarray) -> np.ndarray:
        """Which blocks [n, 3] are the cell's, bool [n]."""
        return np.asarray(((coordinates >= self.low) & (coordinates <= self.high)).all(1))


@dataclass(frozen=True)
class LookTask:
    """Frames to look through for what they tell about.

    Attributes:
        key: number of the first one.
        records: JSON of the visits (`VisitRecord`), without poses.
        views: number of the visit, frame and T_world_camera of each.
        low, high: corners of boxes, float64 [M, 3] metres.
        settings: of the TSDF.
    """

    key: int
    records: tuple[str, ...]
    views: tuple[tuple[int, int, np.ndarray], ...]
    low: np.ndarray
    high: np.ndarray
    settings: TsdfSettings


@dataclass(frozen=True)
class FuseTask:
    """A cell to fuse.

    Attributes:
        key, blocks: of the cell.
        records: JSON of the visits (`VisitRecord`), without poses.
        views: number of the visit, frame and T_world_camera of those that may see it, in their order.
        settings: of the TSDF.
    """

    key: CellKey
    blocks: CellBlocks
    records: tuple[str, ...]
    views: tuple[tuple[int, int, np.ndarray], ...]
    settings: TsdfSettings


@dataclass(frozen=True)
class BlocksTask:
    """A cell whose blocks, and those around them, are known.

    Attributes:
        key, blocks: of the cell.
        tsdf: content of a TSDF's file.
        field: of the distance field; None: a mesh is wanted.
        min_weight: of the mesh, see `VolumeSettings.min_weight`.
    """

    key: CellKey
    blocks: CellBlocks
    tsdf: bytes
    field: FieldSettings | None = None
    min_weight: float = 0.0


@dataclass(frozen=True)
class CellPart:
    """What a worker made of a cell: the content of a part, and how many blocks, triangles or blocks are in it."""

    key: CellKey
    data: bytes
    count: int


def look_at_frames(task: LookTask) -> np.ndarray:
    """Whether each of the frames may tell about each of the boxes, bool [views, M]: those no deeper than what it saw
    and the truncation. Raises GgslamError if a recording cannot be read."""
    seen, s = np.zeros((len(task.views), len(task.low)), bool), task.settings
    for row, (visit, number, T_world_camera) in enumerate(task.views):
        frame = recording_of(task.records[visit]).frame(number, masks=False)
        depth = frame.depth_or_infinity()
        depth = np.where(depth >= s.min_depth, np.minimum(depth, s.most_depth), 0)
        if depth.any():
            reach = depth_reach(depth, *CellVolumeTuning.tiles) + s.truncation
            frustums = Frustums.of(frame.camera, inverse(T_world_camera)[None], reach[None])
            seen[row] = frustums.touch(task.low, task.high)[0]
    return seen


def fuse_cell(task: FuseTask) -> CellPart:
    """The TSDF of a cell. Raises GgslamError if a recording cannot be read."""
    tsdf = TsdfMap(task.settings, NativeContext(own_threads()))
    for visit, number, T_world_camera in task.views:
        frame = recording_of(task.records[visit]).frame(number, masks=False)
        depth, within = frame.depth_or_infinity(), task.blocks.around(0)
        tsdf.integrate(depth, frame.camera, T_world_camera, frame.color, within=within)
    return CellPart(task.key, tsdf_to_bytes(tsdf), len(tsdf))


def mesh_cell(task: BlocksTask) -> CellPart:
    """The triangles of a cell, small pieces among them."""
    mesh = extract_mesh(_tsdf(task), task.min_weight or None)
    corners = mesh.vertices[mesh.triangles].astype(np.float64).mean(1)
    blocks = np.floor(np.floor(corners * (SIDE / task.blocks.edge) - 0.5) / SIDE).astype(int)
    own = mesh.part(task.blocks.own(blocks))
    return CellPart(task.key, mesh_to_bytes(own), len(own.triangles))


def field_cell(task: BlocksTask) -> CellPart:
    """Distances in a cell's voxels: coordinates int32 [B, 3] of its blocks, and float32 [B, 512], NaN: unknown."""
    field = DistanceField(_tsdf(task), task.field)
    field.update()
    coordinates = field.coordinates()
    coordinates = coordinates[task.blocks.own(coordinates)]
    coordinates = coordinates[np.lexsort(coordinates.T)]
    data = arrays_to_bytes(coordinates=coordinates, distance=field.read(coordinates))
    return CellPart(task.key, data, len(coordinates))


def mesh_to_bytes(mesh: Mesh) -> bytes:
    """A mesh as a part of a cell."""
    return arrays_to_bytes(**vars(mesh))


def mesh_from_bytes(data: bytes, what: str) -> Mesh:
    """The mesh of a part. Raises FormatError, which names `what`, if it is none."""
    names = ("vertices", "normals", "colors", "labels", "triangles")
    return arrays_of(io.BytesIO(data), what, lambda held: Mesh(*(held[name] for name in names)))


def _tsdf(task: BlocksTask) -> TsdfMap:
    what = f"cell {task.key}: no TSDF"
    arrays = arrays_of(io.BytesIO(task.tsdf), what, lambda held: {name: held[name] for name in held.files})
    return tsdf_of_arrays(arrays, what, NativeContext(own_threads()))
