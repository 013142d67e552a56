# SPDX-License-Identifier: Apache-2.0
"""Mesh, grids and distances of a run: of the files that `ggslam volumes` made of it, else made now, in a folder that
goes when nobody needs it any more."""

from __future__ import annotations

import math
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ggslam.driving.bands import HeightLayers, floor_plane
from ggslam.driving.robot import Robot
from ggslam.errors import ConfigError
from ggslam.jobs.plan.map_files import TSDF, floor_beside
from ggslam.jobs.plan.ros_maps import RosMap, read_ros_map
from ggslam.jobs.serve.channels import FLOOR, MAP
from ggslam.jobs.serve.tiles import TileTuning, rows_by_key
from ggslam.jobs.volumes.fuse_volumes import fuse_volumes
from ggslam.jobs.volumes.robot_maps import FloorMapTuning, parse_robots
from ggslam.messages.contents import Grid, Mesh, Points
from ggslam.rendering.types import Gaussians
from ggslam.runs.folder import RunFolder
from ggslam.scene.poses import translation
from ggslam.system.tuning import Tuning
from ggslam.volumes.cell_grid import CellGrid
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.floor_frame import floor_from_map
from ggslam.volumes.map_upright import upright_of
from ggslam.volumes.mesh import Mesh as SurfaceMesh
from ggslam.volumes.mesh import extract_mesh
from ggslam.volumes.slices import plane_at_height, slice_field
from ggslam.volumes.tsdf_file import load_tsdf

VOLUMES = "volumes"


class RunVolumesTuning(Tuning):
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
    close_s = 1.0
    """Longest wait for volumes that are being made."""


class RunVolumes:
    """Volumes of a run, read or made when they are asked for first.

    Args:
        folder: the run.
        robots: that grids are made for, as `driving.robot.parse_robot` reads them, besides those that files are of.

    Raises:
        ConfigError: a text is none of a robot's.
    """

    def __init__(self, folder: RunFolder, robots: Sequence[str] = ()) -> None:
        self._folder = folder
        self._robots = {robot.name: robot for robot in parse_robots(robots)}
        self._lock = threading.RLock()
        self._made: tempfile.TemporaryDirectory[str] | None = None
        self._field: DistanceField | None = None

    def place(self) -> Path:
        """The folder of the volumes.

        Raises:
            GgslamError: there are none, and none can be made.
        """
        there = self._folder.path / VOLUMES
        if (there / TSDF).is_file():
            return there
        with self._lock:
            if self._made is None:
                if not self._folder.has_recording:
                    raise ConfigError(f"{self._folder.path}: has no recording that volumes could be made of")
                made = tempfile.TemporaryDirectory(prefix="ggslam-")
                fuse_volumes(self._folder.path, Path(made.name) / VOLUMES, esdf=True, objects=False)
                self._made = made
            return Path(self._made.name) / VOLUMES

    def field(self) -> DistanceField:
        """The distance field, up to date.

        Raises:
            GgslamError: as of `place`, or the file is damaged.
        """
        with self._lock:
            if self._field is None:
                field = DistanceField(load_tsdf(self.place() / TSDF))
                field.update()
                self._field = field
            return self._field

    def T_floor_map(self, gaussians: Callable[[], Gaussians], poses: np.ndarray) -> np.ndarray:
        """Float64 [4, 4]: as floor.yaml says, if volumes were made; else as the map's Gaussians and its poses
        [N, 4, 4] tell."""
        there = self._folder.path / VOLUMES
        found = floor_beside(there / TSDF)[0] if (there / TSDF).is_file() else None
        return floor_from_map(upright_of(gaussians(), poses), poses) if found is None else found

    def floor(self) -> np.ndarray:
        """T_floor_map of the volumes, float64 [4, 4]; errors as of `place`."""
        found = floor_beside(self.place() / TSDF)[0]
        if found is None:
            raise ConfigError(f"{self.place()}: tells no floor (no floor.yaml)")
        return found

    def robots(self) -> list[str]:
        """Names of the robots that there are grids for; "" is any robot's if none is known."""
        files = sorted((self._folder.path / VOLUMES).glob("map_*.yaml"))
        names = {path.stem.removeprefix("map_") for path in files} | set(self._robots)
        return sorted(names) or [""]

    def grid(self, name: str) -> Grid:
        """The floor as a robot meets it, in the floor's frame.

        Raises:
            GgslamError: as of `place`, or a file is damaged.
        """
        if name not in self._robots:
            path = self._folder.path / VOLUMES / (f"map_{name}.yaml" if name else "map.yaml")
            if path.is_file():
                return _grid_of_file(read_ros_map(path))
        with self._lock:
            field = self.field()
            T, seen = floor_beside(self.place() / TSDF)
            plane = floor_plane(field, np.eye(4) if T is None else T)
            area = (plane.high[0] - plane.low[0]) * (plane.high[1] - plane.low[1])
            cell = max(FloorMapTuning.cell_m, field.voxel, math.sqrt(area / RunVolumesTuning.most_cells))
            band = HeightLayers(field, plane, cell, seen).band(self._robots.get(name, Robot()))
        cells = np.where(band.occupied, 100, np.where(band.free, 0, -1)).astype(np.int8)[::-1]
        x, y = band.plane.low
        return Grid(FLOOR, translation(np.array([x, y, 0.0])), band.resolution, np.ascontiguousarray(cells))

    def mesh_parts(self) -> list[Mesh]:
        """The surface in parts, in the map's frame.

        Raises:
            GgslamError: as of `place`, or the file is damaged.
        """
        with self._lock:
            field = self.field()
            mesh = extract_mesh(field.tsdf, min_triangles=RunVolumesTuning.min_piece_triangles)
        cell = field.voxel
        while len(mesh.triangles) > RunVolumesTuning.most_triangles:
            cell *= 2
            mesh = _coarser(mesh, cell)
        middles = mesh.vertices[mesh.triangles].mean(axis=1)
        made = []
        for tile, rows in sorted(rows_by_key(np.floor(middles / TileTuning.edge_m).astype(np.int64)).items()):
            name, count = ",".join(map(str, tile)), -(-len(rows) // RunVolumesTuning.part_triangles)
            made += [_part(mesh, piece, f"{name}/{k}") for k, piece in enumerate(np.array_split(rows, count))]
        return made

    def distance_slice(self, poses: np.ndarray) -> Points:
        """The distance field at the height of the cameras T_map_camera [N, 4, 4]: where it is known, with `distance`
        in metres, negative behind surfaces.

        Raises:
            GgslamError: as of `place`, or the file is damaged.
        """
        with self._lock:
            field = self.field()
            T, _ = floor_beside(self.place() / TSDF)
            up = (np.eye(4) if T is None else T)[2, :3]
            height = float(np.median((poses[:, :3, 3] - field.origin) @ up))
            plane = plane_at_height(field, up, height)
            area = (plane.high[0] - plane.low[0]) * (plane.high[1] - plane.low[1])
            cell = max(FloorMapTuning.cell_m, math.sqrt(area / RunVolumesTuning.slice_points))
            cut = slice_field(field, plane, cell)
        places = CellGrid.over(plane, cell).places()
        return Points(MAP, places[cut.known].astype(np.float32), None, {"distance": cut.distance[cut.known]})

    def close(self) -> None:
        """Removes what was made; what is being made goes when the program ends."""
        if not self._lock.acquire(timeout=RunVolumesTuning.close_s):
            return
        try:
            self._field = None
            if self._made is not None:
                self._made.cleanup()
                self._made = None
        finally:
            self._lock.release()


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


def _part(mesh: SurfaceMesh, rows: np.ndarray, name: str) -> Mesh:
    """Some triangles [N] and their vertices."""
    used, triangles = np.unique(mesh.triangles[rows], return_inverse=True)
    shape = triangles.reshape(-1, 3).astype(np.int32)
    return Mesh(MAP, mesh.vertices[used].astype(np.float32), shape, mesh.colors[used], name)


def _grid_of_file(found: RosMap) -> Grid:
    x, y, yaw = found.origin
    T = translation(np.array([x, y, 0.0]))
    T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    cells = np.where(found.occupied, 100, np.where(found.free, 0, -1)).astype(np.int8)
    return Grid(FLOOR, T, found.resolution, np.ascontiguousarray(cells))
