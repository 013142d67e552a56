# SPDX-License-Identifier: Apache-2.0
"""A house to go round in: four furnished rooms in the corners, four bare corridors between them, a ring of 33 m.

    kitchen --- north corridor --- bedroom
       |                              |
    west corridor              east corridor
       |                              |
    living room - south corridor --- study

The long corridors have parallel walls with paint on them and little else: images say how far one has gone, depth
hardly does. The route leads through all spaces and back into the living room.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ggslam.synthetic.houses import rooms
from ggslam.synthetic.houses.palette import HousePalette
from ggslam.synthetic.materials import Material
from ggslam.synthetic.scene import Light, Placer, Scene, SceneBuilder
from ggslam.system.tuning import Tuning


class HouseTuning(Tuning):
    """Size of the house, and the way through it."""

    height_m = 2.6
    """Height of the rooms, in metres."""
    door_height_m = 2.08
    """Height of doors, in metres."""
    door_width_m = 1.05
    """Width of doors, in metres."""
    half_wall_m = 0.06
    """Thickness of a wall on each side of the line between two rooms, in metres."""
    width_m = 14.4
    """Width inside the outer walls, in metres."""
    depth_m = 10.4
    """Depth inside the outer walls, in metres."""
    # fmt: skip
    route = (
        (2.25, 3.45, 1.42, 255, -14),
        (2.22, 2.55, 1.40, 250, -16),
        (2.75, 2.00, 1.42, 290, -14),
        (3.90, 1.98, 1.45, 352, -9),
        (5.60, 2.04, 1.46, 372, -6),
        (7.50, 1.94, 1.44, 350, -6),
        (9.40, 2.02, 1.42, 366, -8),
        (10.90, 1.95, 1.40, 350, -14),
        (12.00, 1.95, 1.38, 385, -15),
        (12.45, 2.75, 1.42, 440, -12),
        (12.46, 4.20, 1.46, 456, -7),
        (12.42, 5.60, 1.45, 442, -8),
        (12.42, 7.00, 1.42, 450, -14),
        (12.10, 8.10, 1.40, 480, -15),
        (11.10, 8.46, 1.42, 532, -13),
        (9.60, 8.42, 1.45, 546, -7),
        (7.60, 8.50, 1.46, 530, -6),
        (5.60, 8.42, 1.44, 548, -6),
        (4.10, 8.45, 1.42, 536, -10),
        (2.95, 8.40, 1.40, 548, -15),
        (2.30, 7.70, 1.42, 610, -13),
        (2.24, 6.30, 1.45, 634, -8),
        (2.26, 4.90, 1.45, 622, -9),
    )
    """Where the camera goes and looks: x, y, z in metres, heading from the x axis and pitch in degrees; closed."""


@dataclass(frozen=True)
class Space:
    """A room or corridor.

    Attributes:
        name: in the names of its instances.
        low, high: corners (x, y) of its floor.
        floor: material.
        walls: materials of its south, east, north and west wall.
        doors: (side, place along the wall) of openings; sides as above.
    """

    name: str
    low: tuple[float, float]
    high: tuple[float, float]
    floor: Material
    walls: tuple[Material, Material, Material, Material]
    doors: tuple[tuple[str, float], ...]


SIDES = ("south", "east", "north", "west")


def ring_of_rooms(seed: int = 0) -> Scene:
    """The house. The seed changes textures, books and leaves, not the arrangement."""
    m = HousePalette(seed)
    rng = np.random.default_rng([seed, 6])
    b = SceneBuilder()
    spaces = _spaces(m)
    for space in spaces:  # first, since the ray caster skips what is hidden behind earlier shapes
        _shell(b, m, space)
    rooms.living_room(b, m, rng)
    rooms.study(b, m, rng)
    rooms.bedroom(b, m, rng)
    rooms.kitchen(b, m, rng)
    rooms.corridors(b, m)
    scene = b.scene
    scene.lights = [_bound_light(light, spaces) for light in scene.lights]
    scene.bounds = (
        (-HouseTuning.half_wall_m, -HouseTuning.half_wall_m, 0.0),
        (
            HouseTuning.width_m + HouseTuning.half_wall_m,
            HouseTuning.depth_m + HouseTuning.half_wall_m,
            HouseTuning.height_m,
        ),
    )
    scene.route = np.array(HouseTuning.route, float)
    return scene


def _spaces(m: HousePalette) -> tuple[Space, ...]:
    return (
        Space("living room", (0, 0), (4.6, 4.0), m.floor, (m.wallpaper, m.stripes, m.plaster, m.wallpaper),
              (("north", 2.25), ("east", 2.0))),
        Space("south corridor", (4.72, 1.2), (10.28, 2.8), m.flagstones, (m.ochre, m.ochre, m.ochre, m.ochre),
              (("west", 2.0), ("east", 2.0))),
        Space("study", (10.4, 0), (HouseTuning.width_m, 3.9), m.carpet, (m.slate, m.brick, m.slate, m.slate),
              (("west", 2.0), ("north", 12.45))),
        Space("east corridor", (11.7, 4.02), (13.2, 6.48), m.clay, (m.teal, m.teal, m.teal, m.teal),
              (("south", 12.45), ("north", 12.45))),
        Space("bedroom", (10.1, 6.6), (HouseTuning.width_m, HouseTuning.depth_m), m.parquet,
              (m.rosy, m.lilac, m.lilac, m.rosy),
              (("south", 12.45), ("west", 8.45))),
        Space("north corridor", (4.42, 7.7), (9.98, 9.2), m.parquet, (m.panels, m.panels, m.panels, m.panels),
              (("east", 8.45), ("west", 8.45))),
        Space("kitchen", (0, 6.5), (4.3, HouseTuning.depth_m), m.kitchen_floor, (m.sage, m.sage, m.wall_tiles, m.sage),
              (("east", 8.45), ("south", 2.25))),
        Space("west corridor", (1.5, 4.12), (3.0, 6.38), m.clay, (m.brickwork, m.brickwork, m.brickwork, m.brickwork),
              (("north", 2.25), ("south", 2.25))),
    )  # fmt: skip


def _bound_light(light: Light, spaces: tuple[Space, ...]) -> Light:
    """The light, ending in the openings of the space it is in: what it sends further is little and costly."""
    x, y = light.points[:, :2].mean(0)
    t = HouseTuning.half_wall_m
    for space in spaces:
        (x0, y0), (x1, y1) = space.low, space.high
        if x0 <= x <= x1 and y0 <= y <= y1:
            return replace(light, bounds=((x0 - t, y0 - t, 0.0), (x1 + t, y1 + t, HouseTuning.height_m)))
    return light


def _shell(b: SceneBuilder, m: HousePalette, space: Space) -> None:
    """Floor, ceiling, walls with openings, skirting and the frames of the openings."""
    (x0, y0), (x1, y1) = space.low, space.high
    x, y, t = (x0 + x1) / 2, (y0 + y1) / 2, HouseTuning.half_wall_m
    size = (x1 - x0 + 2 * t, y1 - y0 + 2 * t)
    b.instance(f"{space.name} floor").box((x, y, -0.05), (*size, 0.1), space.floor)
    b.instance(f"{space.name} ceiling").box((x, y, HouseTuning.height_m + 0.05), (*size, 0.1), m.ceiling)
    # In each wall's own axes x runs along it, y points out of the space, as for things that stand before a wall.
    middles = {"south": (x, y0, 180.0), "east": (x1, y, -90.0), "north": (x, y1, 0.0), "west": (x0, y, 90.0)}
    for side, material in zip(SIDES, space.walls, strict=True):
        cx, cy, turn = middles[side]
        level = side in ("south", "north")
        length = (x1 - x0) if level else (y1 - y0)
        flip = -1.0 if side in ("south", "east") else 1.0
        doors = sorted(flip * (at - (cx if level else cy)) for where, at in space.doors if where == side)
        wall = b.instance(f"{space.name} {side} wall", (cx, cy, 0.0), turn)
        _wall(wall, m, length, material, doors)


def _wall(wall: Placer, m: HousePalette, length: float, material: Material, doors: list[float]) -> None:
    t, half, opening = HouseTuning.half_wall_m, length / 2 + HouseTuning.half_wall_m, HouseTuning.door_width_m / 2
    edges = [-half, *(edge for door in doors for edge in (door - opening, door + opening)), half]
    for left, right in zip(edges[::2], edges[1::2], strict=True):
        middle, width = (left + right) / 2, right - left
        wall.box((middle, t / 2, HouseTuning.height_m / 2), (width, t, HouseTuning.height_m), material)
        wall.box((middle, -0.008, 0.05), (width, 0.016, 0.10), m.white)
    for door in doors:
        wall.box(
            (door, t / 2, (HouseTuning.height_m + HouseTuning.door_height_m) / 2),
            (HouseTuning.door_width_m, t, HouseTuning.height_m - HouseTuning.door_height_m),
            material,
        )
        for side in (-1, 1):
            wall.box(
                (door + side * (opening + 0.04), -0.012, HouseTuning.door_height_m / 2),
                (0.08, 0.024, HouseTuning.door_height_m),
                m.white,
            )
        wall.box(
            (door, -0.012, HouseTuning.door_height_m + 0.04), (HouseTuning.door_width_m + 0.16, 0.024, 0.08), m.white
        )
