# SPDX-License-Identifier: Apache-2.0
"""Maps to plan on, out of the files that people have: volumes, OctoMap's trees, maps of ROS's map_server."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.driving.plan_maps import (
    FieldCells,
    OccupancyFloor,
    OccupancySpace,
    PlanMap,
    WholeArray,
    field_frame,
    floor_cells,
)
from ggslam.driving.plan_settings import PlanSettings
from ggslam.driving.robot import Robot
from ggslam.errors import FormatError
from ggslam.jobs.plan.bands import band_cells, floor_of_field
from ggslam.jobs.plan.ros_maps import read_ros_map, read_yaml
from ggslam.jobs.plan.store_maps import VOLUMES, is_store, open_store_map
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import inverse, translation
from ggslam.system.tuning import Tuning
from ggslam.system.untrusted_files import given_path
from ggslam.volumes.esdf import DistanceField, FieldSettings
from ggslam.volumes.floor_frame import FLOOR_FILE
from ggslam.volumes.octomap_files import read_octomap
from ggslam.volumes.output_frame import OutputFrame
from ggslam.volumes.tsdf_file import load_tsdf

TSDF = "tsdf.npz"
_OCTOMAPS = (".bt", ".ot")
_ROS_MAPS = (".yaml", ".yml")


class PlanFileTuning(Tuning):
    """How finely maps are planned on."""

    cells_in_clearance = 4.0
    """Cells in the least clearance, at least, as far as voxels are fine enough."""
    coarsest_m = 0.05
    """Largest cell, in metres, unless voxels are larger."""


@dataclass(frozen=True)
class MapRequest:
    """What a map is opened for.

    Attributes:
        path: of the map.
        robot: that drives.
        fly: whether it flies instead.
        clearance: least distance from its middle to obstacles, metres.
        settings: of the paths.
        start: [3], where a path begins: the floor of maps that do not tell where theirs is.
    """

    path: Path
    robot: Robot
    fly: bool
    clearance: float
    settings: PlanSettings
    start: np.ndarray

    @property
    def reach(self) -> float:
        """Distance from obstacles beyond which all distances are the same to a planner, metres."""
        return self.clearance + self.settings.margin

    def cell(self, voxel: float) -> float:
        """Edge of cells, metres, on maps with voxels of an edge."""
        return max(voxel, min(PlanFileTuning.coarsest_m, self.clearance / PlanFileTuning.cells_in_clearance))


def open_plan_map(request: MapRequest) -> PlanMap:
    """A map to plan on.

    Raises:
        GgslamError: it cannot be read, or is of no kind that one can plan on.
    """
    path = given_path(request.path, FormatError)
    ending = path.suffix.lower()
    if ending in _OCTOMAPS:
        return _of_octomap(path, request)
    if ending in _ROS_MAPS:
        return _of_ros_map(path, request)
    if ending == ".npz":
        return _of_tsdf(path, request)
    for folder in (path, path / VOLUMES):
        if (folder / TSDF).is_file():
            return _of_tsdf(folder / TSDF, request)
    if is_store(path):
        return open_store_map(path, request.robot, request.fly, request.cell, request.reach, request.settings.unknown,
                              request.start)  # fmt: skip
    said = (
        "expected volumes (a folder with tsdf.npz, or a run or grid store with a folder called volumes), an OctoMap "
        "(.bt, .ot) or a ROS map (.yaml)"
    )
    if path.is_dir():
        raise FormatError(f"{path}: {said}; `ggslam volumes` makes volumes of a run, a recording or a store")
    raise FormatError(f"{path}: file is missing: {said}" if not path.exists() else f"{path}: {said}")


def _of_tsdf(path: Path, request: MapRequest) -> PlanMap:
    tsdf = load_tsdf(path)
    field = DistanceField(tsdf, FieldSettings(max_distance=max(2 * tsdf.settings.voxel, request.reach + 0.1)))
    field.update()
    T_floor_map, floor_seen = floor_beside(path)
    if T_floor_map is None:
        T_floor_map = floor_of_field(field)
    if request.fly:
        step = max(k for k in (1, 2, 4, 8) if k == 1 or k * field.voxel <= request.cell(field.voxel) * 1.001)
        frame = field_frame(field.origin, field.voxel, step)
        return PlanMap(_name(path), 3, step * field.voxel, frame, FieldCells(field, step), T_floor_map)
    cell = request.cell(field.voxel)
    low, clearance = band_cells(field, T_floor_map, request.robot, cell, request.reach, request.settings.unknown,
                                floor_seen=floor_seen)  # fmt: skip
    T_grid_map = translation(-np.array([*low, 0.0])) @ T_floor_map
    return PlanMap(_name(path), 2, cell, T_grid_map, WholeArray((0, 0, 0), clearance), T_floor_map)


def floor_beside(path: Path, of_files: bool = False) -> tuple[np.ndarray | None, bool]:
    """T_floor_map [4, 4] as floor.yaml beside a file says, None: there is none; and whether it is no guess. `of_files`:
    from the frame that meshes and occupancy beside it are in."""
    file = path.parent / FLOOR_FILE
    if not file.is_file():
        return None, True
    values = read_yaml(file)
    numbers = values.get("T_floor_map")
    good = isinstance(numbers, list) and len(numbers) == 16 and all(isinstance(v, (int, float)) for v in numbers)
    if not good or not np.isfinite(np.array(numbers, float)).all():
        raise FormatError(f"{file}: T_floor_map: expected 16 finite numbers, found {str(numbers)[:80]}")
    seen = values.get("floor_was_seen") is not False
    if of_files and values.get("files_are_in") == OutputFrame.floor.value:
        return np.eye(4), seen
    return np.array(numbers, float).reshape(4, 4), seen


def _of_octomap(path: Path, request: MapRequest) -> PlanMap:
    occupancy = read_octomap(path)
    T_floor_map, _ = floor_beside(path, of_files=True)
    if T_floor_map is None:  # z is up there
        T_floor_map = translation(-np.array([0.0, 0.0, request.start[2]]))
    reach, unknown = request.reach, request.settings.unknown
    if request.fly:
        pages = OccupancySpace(occupancy, reach, unknown)
        return PlanMap(path.name, 3, occupancy.resolution, translation(-occupancy.origin), pages, T_floor_map)
    floor = OccupancyFloor(occupancy, T_floor_map, request.robot.band, reach, unknown)
    return PlanMap(path.name, 2, occupancy.resolution, T_floor_map, floor, T_floor_map)


def _of_ros_map(path: Path, request: MapRequest) -> PlanMap:
    if request.fly:
        raise FormatError(f"{path}: a map of a floor; flying takes volumes or an OctoMap")
    found = read_ros_map(path)
    x, y, yaw = found.origin
    T_map_grid = translation(np.array([x, y, 0.0]))
    T_map_grid[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    reach, unknown = request.reach, request.settings.unknown
    clearance = floor_cells(found.occupied, found.free, found.resolution, reach, unknown, NativeContext())
    return PlanMap(path.name, 2, found.resolution, inverse(T_map_grid), WholeArray((0, 0, 0), clearance), np.eye(4))


def _name(path: Path) -> str:
    return path.parent.name or path.name
