# SPDX-License-Identifier: Apache-2.0
"""Maps of a floor for map_server: obstacles between two heights, and for each robot what it meets and what it costs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ggslam.driving.bands import HeightLayers
from ggslam.driving.inflation import Inflation, inflated_cost
from ggslam.driving.map_files import write_costmap, write_map
from ggslam.driving.pictures import band_picture
from ggslam.driving.robot import Robot, parse_robot
from ggslam.errors import ConfigError
from ggslam.reporting.pictures import write_picture
from ggslam.system.tuning import Tuning
from ggslam.volumes.cell_field import AnyField
from ggslam.volumes.cell_grid import SlicePlane


class FloorMapTuning(Tuning):
    """Cells of maps of a floor."""

    cell_m = 0.05
    """Edge of a cell in metres, or the voxel's, if that is more: what ROS's maps usually have."""


def parse_robots(texts: Sequence[str]) -> list[Robot]:
    """Robots as the command line writes them; those without a name become robot, robot2, ...

    Raises:
        ConfigError: a text is none of a robot's, or two have the same name.
    """
    robots = []
    for number, text in enumerate(texts, 1):
        robot = parse_robot(text)
        robots.append(robot if robot.name else replace(robot, name="robot" if number == 1 else f"robot{number}"))
    names = [robot.name.lower() for robot in robots]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"`robot`: expected a name of its own for each, found {name!r} twice")
    return robots


def floor_layers(field: AnyField, floor: SlicePlane, most_cells: int, seen: bool) -> HeightLayers:
    """What a volume has above its floor, `seen` or guessed, in cells that are larger where there would be too many."""
    area = (floor.high[0] - floor.low[0]) * (floor.high[1] - floor.low[1])
    return HeightLayers(field, floor, max(FloorMapTuning.cell_m, field.voxel, math.sqrt(area / most_cells)), seen)


def write_robot_maps(
    layers: HeightLayers, robots: Sequence[Robot], inflation: Inflation, folder: Path
) -> tuple[list[Path], dict[str, dict[str, float]]]:
    """Writes the maps of some robots, and a picture of each, into a folder.

    Args:
        layers: of the volume.
        robots: with names.
        inflation: how costs fall off.
        folder: is there.

    Returns:
        The files; and of each robot its size, and square metres: that are free, that its centre may be in, and where
        the floor falls away.
    """
    files, facts = [], {}
    for robot in robots:
        band = layers.band(robot)
        cost = inflated_cost(band, robot.radius, inflation)
        picture = folder / f"robot_{robot.name}.png"
        size = f"{robot.height:g} m high, radius {robot.radius:g} m, obstacles from {robot.step:g} m up"
        write_picture(picture, band_picture(band, cost, robot.radius, f"{robot.name}: {size}"))
        files += [
            *write_map(band, folder / f"map_{robot.name}"),
            *write_costmap(band, cost, folder / f"costmap_{robot.name}"),
        ]
        files.append(picture)
        cell = band.resolution**2
        reachable = band.free & (band.distance > robot.radius)
        facts[robot.name] = {
            "height": robot.height, "radius": robot.radius, "step": robot.step,
            "free_m2": cell * np.count_nonzero(band.free), "for_its_centre_m2": cell * np.count_nonzero(reachable),
            "drops_m2": cell * np.count_nonzero(layers.drops(robot.step)),
        }  # fmt: skip
    return files, facts
