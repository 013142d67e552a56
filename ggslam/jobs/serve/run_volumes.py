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

from ggslam.driving.robot import Robot
from ggslam.errors import ConfigError, GgslamError
from ggslam.jobs.plan.map_files import TSDF, floor_beside
from ggslam.jobs.plan.ros_maps import RosMap, read_ros_map
from ggslam.jobs.serve.channels import FLOOR
from ggslam.jobs.serve.keyframe_volumes import KeyframeVolumes
from ggslam.jobs.serve.volume_contents import (
    grid_of,
    layers_of,
    mesh_parts_of_tile,
    published_mesh,
    slice_of,
    tiles_of_mesh,
)
from ggslam.jobs.volumes.fuse_volumes import fuse_volumes
from ggslam.jobs.volumes.robot_maps import parse_robots
from ggslam.messages.contents import Grid, Mesh, Points
from ggslam.rendering.types import Gaussians
from ggslam.runs.folder import RunFolder
from ggslam.scene.poses import translation
from ggslam.system.tuning import Tuning
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.floor_frame import floor_from_map
from ggslam.volumes.map_upright import upright_of
from ggslam.volumes.tsdf_file import load_tsdf

VOLUMES = "volumes"


class RunVolumesTuning(Tuning):
    """How volumes of runs are made."""

    close_s = 1.0
    """Longest wait, in seconds, for volumes that are being made."""


class RunVolumes:
    """Volumes of a run, read or made when they are asked for first.

    Args:
        folder: the run.
        robots: that grids are made for, as `driving.robot.parse_robot` reads them, besides those that files are of.
        keyframes: of the run, which volumes are made of where it has no recording; None: none are.

    Raises:
        ConfigError: a text is none of a robot's.
    """

    def __init__(
        self, folder: RunFolder, robots: Sequence[str] = (), keyframes: KeyframeVolumes | None = None
    ) -> None:
        self._folder, self._keyframes = folder, keyframes
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
                made = tempfile.TemporaryDirectory(prefix="ggslam-")
                self._make(Path(made.name) / VOLUMES)
                self._made = made
            return Path(self._made.name) / VOLUMES

    def _make(self, place: Path) -> None:
        """Of the recording; where there is none, of the keyframes."""
        try:
            if not self._folder.has_recording:
                raise ConfigError(f"{self._folder.path}: has no recording that volumes could be made of")
            fuse_volumes(self._folder.path, place, esdf=True, objects=False)
        except GgslamError:
            if self._keyframes is None:
                raise
            self._keyframes.write(place)

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
            layers = layers_of(field, np.eye(4) if T is None else T, seen)
            return grid_of(layers, self._robots.get(name, Robot()))

    def mesh_parts(self) -> list[Mesh]:
        """The surface in parts, in the map's frame.

        Raises:
            GgslamError: as of `place`, or the file is damaged.
        """
        with self._lock:
            mesh = published_mesh(self.field().tsdf)
        tiles = sorted(tiles_of_mesh(mesh).items())
        return [part for tile, rows in tiles for part in mesh_parts_of_tile(mesh, tile, rows)]

    def distance_slice(self, poses: np.ndarray) -> Points:
        """The distance field at the height of the cameras T_map_camera [N, 4, 4]: where it is known, with `distance`
        in metres, negative behind surfaces.

        Raises:
            GgslamError: as of `place`, or the file is damaged.
        """
        with self._lock:
            field = self.field()
            T, _ = floor_beside(self.place() / TSDF)
            return slice_of(field, (np.eye(4) if T is None else T)[2, :3], poses)

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


def _grid_of_file(found: RosMap) -> Grid:
    x, y, yaw = found.origin
    T = translation(np.array([x, y, 0.0]))
    T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    cells = np.where(found.occupied, 100, np.where(found.free, 0, -1)).astype(np.int8)
    return Grid(FLOOR, T, found.resolution, np.ascontiguousarray(cells))
