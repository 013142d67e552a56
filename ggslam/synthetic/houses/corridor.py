# SPDX-License-Identifier: Apache-2.0
"""A corridor as long as the recording: furnished sections of 4 m, one after the other, each unlike its neighbours.

The camera goes from one end towards the other and looks to both sides by turns. Whatever it sees it sees once, so that
a map grows evenly with the way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ggslam.synthetic import furniture
from ggslam.synthetic.houses import furniture as house_furniture
from ggslam.synthetic.houses.palette import HousePalette
from ggslam.synthetic.houses.rooms import ceiling_lamp
from ggslam.synthetic.materials import Material
from ggslam.synthetic.scene import Scene, SceneBuilder
from ggslam.system.tuning import Tuning


class CorridorTuning(Tuning):
    """Size of the corridor, and the way through it."""

    section_m = 4.0
    """Length of a section, in metres."""
    width_m = 3.2
    """Width, in metres."""
    height_m = 2.6
    """Height, in metres."""
    wall_m = 0.1
    """Thickness of walls, in metres."""
    start_m = 1.5
    """Distance from the first wall to where the camera starts, in metres."""
    ahead_m = 5.0
    """Shortest corridor beyond the end of the way, in metres."""
    pace_m = 0.061
    """Metres per frame that the way is made for, a little more than the camera goes."""
    swing_deg = 48.0
    """Angle by which the camera looks to the sides, in degrees."""
    turn_after_m = 2.0
    """Way after which it looks elsewhere, in metres."""


Piece = Callable[["_Spot"], None]


def furnished_corridor(seed: int = 0, frames: int = 720, bare: bool = False) -> Scene:
    """The corridor, long enough for a walk of so many frames. The seed decides what stands where; `bare`: nothing does,
    and there are no arches."""
    m = HousePalette(seed)
    b = SceneBuilder()
    way = CorridorTuning.pace_m * frames + CorridorTuning.turn_after_m
    sections = int(np.ceil((CorridorTuning.start_m + way + CorridorTuning.ahead_m) / CorridorTuning.section_m))
    length = sections * CorridorTuning.section_m
    b.instance("first wall").box(
        (-CorridorTuning.wall_m / 2, CorridorTuning.width_m / 2, CorridorTuning.height_m / 2),
        (CorridorTuning.wall_m, CorridorTuning.width_m, CorridorTuning.height_m),
        m.brick,
    )
    b.instance("last wall").box(
        (length + CorridorTuning.wall_m / 2, CorridorTuning.width_m / 2, CorridorTuning.height_m / 2),
        (CorridorTuning.wall_m, CorridorTuning.width_m, CorridorTuning.height_m),
        m.brick,
    )
    for number in range(sections):
        _section(b, m, number, seed, bare)
    b.scene.bounds = ((0.0, 0.0, 0.0), (length, CorridorTuning.width_m, CorridorTuning.height_m))
    b.scene.lights = [
        replace(
            light,
            bounds=(
                (x - 1.5 * CorridorTuning.section_m, 0.0, 0.0),
                (x + 1.5 * CorridorTuning.section_m, CorridorTuning.width_m, CorridorTuning.height_m),
            ),
        )
        for light in b.scene.lights
        for x in (float(light.points[:, 0].mean()),)
    ]
    b.scene.route = _route(way)
    b.scene.walk = ((CorridorTuning.start_m + 1.0, CorridorTuning.width_m / 2, 1.45), (0.7, 0.3))
    b.scene.interest = np.array(
        [(CorridorTuning.start_m + 3.0, 0.2, 1.0), (CorridorTuning.start_m + 3.0, CorridorTuning.width_m - 0.2, 1.0)]
    )
    return b.scene


def _route(way: float) -> np.ndarray:
    """Rows of `Scene.route` every `CorridorTuning.turn_after_m` metres: straight on, left, straight on, right."""
    i = np.arange(max(3, int(np.ceil(way / CorridorTuning.turn_after_m)) + 1))
    x = CorridorTuning.start_m + CorridorTuning.turn_after_m * i
    y = CorridorTuning.width_m / 2 + 0.25 * np.sin(1.3 * i)
    z = 1.45 + 0.04 * np.sin(2.1 * i)
    return np.stack([x, y, z, CorridorTuning.swing_deg * np.sin(np.pi / 2 * i), -9 + 3 * np.cos(1.7 * i)], 1)


class _Spot:
    """A place before a wall: x along the corridor, at the north wall (front to the south) or at the south wall."""

    def __init__(self, b: SceneBuilder, m: HousePalette, rng: np.random.Generator, x: float, north: bool) -> None:
        self.b, self.m, self.rng, self.x, self.north = b, m, rng, x, north
        self.turn = 0.0 if north else 180.0

    def at(self, out: float, z: float = 0.0) -> tuple[float, float, float]:
        """So many metres before the wall, at height z."""
        return self.x, CorridorTuning.width_m - out if self.north else out, z

    def one_of(self, materials: list[Material]) -> Material:
        """A material at random."""
        return materials[int(self.rng.integers(len(materials)))]


def _section(b: SceneBuilder, m: HousePalette, number: int, seed: int, bare: bool) -> None:
    """Floor, ceiling, walls and what stands before them. Depends on nothing but the section's number and the seed."""
    rng = np.random.default_rng([seed, 12, number])
    x = (number + 0.5) * CorridorTuning.section_m
    walls = [m.wallpaper, m.stripes, m.plaster, m.slate, m.lilac, m.rosy, m.sage, m.ochre, m.panels, m.teal,
             m.brickwork, m.brick, m.wall_tiles]  # fmt: skip
    floors = [m.floor, m.carpet, m.parquet, m.kitchen_floor, m.flagstones, m.clay]
    floor, south, north = number * 5 % 6, *((number * step + rng.integers(4)) % len(walls) for step in (4, 5))
    b.instance("floor").box(
        (x, CorridorTuning.width_m / 2, -CorridorTuning.wall_m / 2),
        (CorridorTuning.section_m, CorridorTuning.width_m, CorridorTuning.wall_m),
        floors[floor],
    )
    b.instance("ceiling").box(
        (x, CorridorTuning.width_m / 2, CorridorTuning.height_m + CorridorTuning.wall_m / 2),
        (CorridorTuning.section_m, CorridorTuning.width_m, CorridorTuning.wall_m),
        m.ceiling,
    )
    for name, y, inward, material in (
        ("south wall", 0.0, 1, walls[south]),
        ("north wall", CorridorTuning.width_m, -1, walls[north]),
    ):
        wall = b.instance(name)
        wall.box(
            (x, y - inward * CorridorTuning.wall_m / 2, CorridorTuning.height_m / 2),
            (CorridorTuning.section_m, CorridorTuning.wall_m, CorridorTuning.height_m),
            material,
        )
        wall.box((x, y + inward * 0.008, 0.05), (CorridorTuning.section_m, 0.016, 0.10), m.white)
    ceiling_lamp(b, m, x, CorridorTuning.width_m / 2, (2.3, 2.1, 1.75))
    if bare:
        return
    arch = b.instance("arch")
    for y in (0.1, CorridorTuning.width_m - 0.1):
        arch.box(
            (number * CorridorTuning.section_m, y, CorridorTuning.height_m / 2),
            (0.24, 0.2, CorridorTuning.height_m),
            m.white,
            faces={0: m.oak, 1: m.oak},
        )
    arch.box(
        (number * CorridorTuning.section_m, CorridorTuning.width_m / 2, CorridorTuning.height_m - 0.11),
        (0.24, CorridorTuning.width_m - 0.4, 0.22),
        m.walnut,
    )
    pieces = [rng.permutation(len(PIECES))[:4], ("south", "south", "north", "north"), (1.15, 2.95, 1.15, 2.95)]
    for piece, side, place in zip(*pieces, strict=True):
        along = number * CorridorTuning.section_m + place + float(rng.uniform(-0.1, 0.1))
        PIECES[piece](_Spot(b, m, rng, along, side == "north"))


def _door(spot: _Spot) -> None:
    m, door = spot.m, spot.b.instance("door", spot.at(0.0), spot.turn)
    door.box((0, -0.02, 1.0), (0.86, 0.04, 2.0), m.white, faces={2: m.door})
    for x in (-0.46, 0.46):
        door.box((x, -0.025, 1.03), (0.08, 0.05, 2.06), spot.one_of([m.white, m.oak, m.walnut]))
    door.box((0, -0.025, 2.05), (1.0, 0.05, 0.09), m.white)
    door.ellipsoid((0.34, -0.07, 1.0), (0.03, 0.03, 0.03), m.brass)
    door.box((0, -0.045, 1.55), (0.3, 0.012, 0.3), m.white, faces={2: spot.one_of(m.posters)})


def _chest(spot: _Spot) -> None:
    m, rng = spot.m, spot.rng
    height = float(rng.uniform(0.6, 1.0))
    fronts = [m.drawers, m.dresser_front, m.cabinet_front, m.cupboard, m.counter_front]
    size = (float(rng.uniform(0.9, 1.4)), 0.44, height)
    house_furniture.chest(
        spot.b, "chest", spot.at(0.23), spot.turn, size, spot.one_of(fronts), spot.one_of([m.pine, m.oak, m.walnut])
    )
    spot.x -= 0.3
    furniture.book_pile(spot.b, m, rng, spot.at(0.23, height), 3)
    spot.x += 0.55
    furniture.mug(spot.b, spot.one_of(m.mugs), m.coffee, spot.at(0.3, height), float(rng.uniform(0, 360)))
    spot.x -= 0.25
    _picture(spot)


def _picture(spot: _Spot) -> None:
    m, rng = spot.m, spot.rng
    width, height = rng.uniform((0.5, 0.45), (1.0, 0.75))
    painting = spot.one_of([*m.paintings, *m.posters])
    furniture.picture(spot.b, m, painting, spot.at(0.0, 1.65), spot.turn, float(width), float(height))


def _bookshelf(spot: _Spot) -> None:
    furniture.bookshelf(spot.b, spot.m, spot.rng, spot.at(0.17), spot.turn, float(spot.rng.uniform(0.8, 1.3)))


def _wardrobe(spot: _Spot) -> None:
    house_furniture.wardrobe(spot.b, spot.m, spot.at(0.33), spot.turn)


def _armchair(spot: _Spot) -> None:
    furniture.armchair(spot.b, spot.m, spot.at(0.42), spot.turn + float(spot.rng.uniform(-15, 15)))
    _picture(spot)


def _plant(spot: _Spot) -> None:
    furniture.plant(spot.b, spot.m, spot.rng, spot.at(0.45), float(spot.rng.uniform(0.7, 1.0)))
    _picture(spot)


def _table(spot: _Spot) -> None:
    m = spot.m
    wood = spot.one_of([m.pine, m.oak, m.walnut, m.white])
    furniture.table(spot.b, "table", spot.at(0.35), spot.turn, (1.1, 0.55, 0.75), wood, m.walnut)
    furniture.fruit_bowl(spot.b, m, spot.at(0.35, 0.75))
    furniture.chair(spot.b, "chair", spot.at(0.62), spot.turn + float(spot.rng.uniform(150, 210)), m.oak, m.rose)
    _picture(spot)


def _whiteboard(spot: _Spot) -> None:
    m = spot.m
    house_furniture.whiteboard(spot.b, m, spot.at(0.0, 1.5), spot.turn, 1.5, 0.95)
    basket = spot.b.instance("basket", spot.at(0.25))
    basket.cylinder((0, 0, 0.18), 0.17, 0.36, m.wicker, top=1.15, cap=m.earth)
    spot.b.instance("mat", spot.at(0.6)).box((0, 0, 0.006), (1.2, 0.7, 0.012), spot.one_of([m.blue_rug, m.runner]))


PIECES: tuple[Piece, ...] = (
    _door, _chest, _picture, _bookshelf, _wardrobe, _armchair, _plant, _table, _whiteboard, _door, _chest,
)  # fmt: skip
"""What may stand at a place; four of them in each section."""
