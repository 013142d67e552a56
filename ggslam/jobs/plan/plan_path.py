# SPDX-License-Identifier: Apache-2.0
"""Plans a path through a map of any kind and writes it.

path.json   points, clearances and headings, in the map's frame; or why there is no path
path.png    the path over the clearances around
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.driving.plan_settings import PlanSettings
from ggslam.driving.planner import PlannedPath, Planner
from ggslam.driving.robot import Robot, parse_robot
from ggslam.errors import InputError
from ggslam.jobs.plan.map_files import MapRequest, open_plan_map
from ggslam.jobs.plan.pictures import path_picture
from ggslam.reporting.pictures import write_picture
from ggslam.scene.poses import inverse, transform_points
from ggslam.system.atomic import make_folder
from ggslam.system.json_files import write_json

RECORD, PICTURE = "path.json", "path.png"


def plan_path(
    path: str | Path,
    start: Sequence[float],
    goal: Sequence[float],
    *,
    robot: Robot | str | None = None,
    fly: bool = False,
    clearance: float | None = None,
    unknown: bool = False,
    margin: float = PlanSettings.margin,
    weight: float = PlanSettings.weight,
    frame: str = "map",
    out: str | Path | None = None,
) -> PlannedPath:
    """Plans a path through a map that `ggslam volumes`, OctoMap or ROS's map_server wrote, as `ggslam plan` does.

    Args:
        path: folder of volumes, run or grid store with volumes, OctoMap (.bt, .ot) or ROS map (.yaml).
        start, goal: [3], metres. For a robot that drives heights do not count, but where a map does not tell where its
            floor is: there it is as high as the start.
        robot: its size, such as "0.4,0.2": height and radius in metres; a third number is the height that it can drive
            over. None: 0.4 m high, 0.2 m in radius.
        fly: whether it flies.
        clearance: least distance from its middle to obstacles, metres; None: its radius, for one that flies that of the
            ball around it.
        unknown: whether it may enter what nobody has seen.
        margin, weight: clearance that it keeps beyond that where it can, metres, and the share that the path may be
            longer for it.
        frame: of start, goal and path: "map", or "floor" (z up, 0 on the floor).
        out: folder for path.json and path.png; None: nothing is written.

    Returns:
        The path, or why there is none (`reason`).

    Raises:
        GgslamError: the map cannot be read, or the path not be written.
    """
    if frame not in ("map", "floor"):
        raise InputError(f"frame: expected map or floor, found {frame!r}")
    robot = parse_robot(robot) if isinstance(robot, str) else robot or Robot()
    settings = PlanSettings(margin=margin, weight=weight, unknown=unknown)
    if clearance is None:
        clearance = math.hypot(robot.radius, robot.height / 2) if fly else robot.radius
    ends = np.array([_place("start", start), _place("goal", goal)])
    around = ends[0] if frame == "map" else np.zeros(3)
    request = MapRequest(Path(path), robot, fly, clearance, settings, around)
    with open_plan_map(request) as plan_map:
        planner = Planner(plan_map, clearance, settings, np.eye(4) if frame == "map" else plan_map.T_floor_map)
        in_map = ends if frame == "map" else transform_points(ends, inverse(plan_map.T_floor_map))
        found = planner.plan(in_map[0], in_map[1])
        if frame == "floor":
            found = found.in_frame(plan_map.T_floor_map)
        if out is not None:
            _write(Path(out), planner, found, in_map, ends, frame, robot if not fly else None)
    return found


def _write(
    out: Path, planner: Planner, found: PlannedPath, in_map: np.ndarray, ends: np.ndarray, frame: str,
    robot: Robot | None,
) -> None:  # fmt: skip
    make_folder(out)
    shown = found if frame == "map" else found.in_frame(inverse(planner.map.T_floor_map))
    write_picture(out / PICTURE, path_picture(planner, shown, in_map[0], in_map[1]))
    write_json(out / RECORD, _record(planner, found, ends, frame, robot))


def _record(planner: Planner, found: PlannedPath, ends: np.ndarray, frame: str, robot: Robot | None) -> dict[str, Any]:
    drives = None if robot is None else {"height": robot.height, "radius": robot.radius, "step": robot.step}
    return {
        "map": planner.map.name, "frame": frame, "found": found.is_found, "reason": found.reason,
        "narrowest": found.narrowest, "robot": drives, "start": ends[0], "goal": ends[1],
        "clearance_asked_m": found.asked, "least_clearance_m": found.least_clearance if found.is_found else None,
        "length_m": found.length, "cell_m": planner.map.cell, "points": found.points,
        "clearances_m": found.clearance, "yaws_rad": found.yaw, "T_floor_map": planner.map.T_floor_map,
        "milliseconds": found.milliseconds, "cells_searched": found.cells, "pages_read": found.pages,
    }  # fmt: skip


def _place(name: str, values: Sequence[float]) -> np.ndarray:
    try:
        point = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        point = np.zeros(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(f"{name}: expected three finite numbers of metres, found {str(values)[:80]}")
    return point
