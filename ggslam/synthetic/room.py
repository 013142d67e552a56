# SPDX-License-Identifier: Apache-2.0
"""A furnished living room, the scene of the generated recording."""

from __future__ import annotations

import numpy as np

from ggslam.synthetic import furniture
from ggslam.synthetic.materials import Material
from ggslam.synthetic.palette import Palette
from ggslam.synthetic.scene import Scene, SceneBuilder
from ggslam.system.tuning import Tuning


class RoomSize(Tuning):
    """Size of the room."""

    width_m = 5.2
    """From west to east, x, in metres."""
    depth_m = 4.4
    """From south to north, y, in metres."""
    height_m = 2.6
    """From floor to ceiling, z, in metres."""
    wall_m = 0.1
    """Thickness of walls, floor and ceiling, in metres."""


def furnished_room(seed: int = 0) -> Scene:
    """A living room with about fifty instances. The seed changes textures, books and leaves, not the arrangement."""
    m = Palette(seed)
    rng = np.random.default_rng([seed, 2])
    b = SceneBuilder()
    _shell(b, m)
    _lounge(b, m, rng)
    _west_side(b, m, rng)
    _desk_corner(b, m, rng)
    _south_side(b, m, rng)
    scene = b.scene
    scene.bounds = ((0.0, 0.0, 0.0), (RoomSize.width_m, RoomSize.depth_m, RoomSize.height_m))
    scene.walk = ((3.15, 1.75, 1.45), (0.75, 0.55))
    scene.interest = np.array(
        [(1.9, 3.3, 0.75), (0.4, 2.4, 0.85), (0.9, 0.8, 0.7), (2.4, 0.2, 0.8), (4.9, 1.6, 0.85), (4.2, 4.0, 0.95)]
    )
    return scene


def _shell(b: SceneBuilder, m: Palette) -> None:
    x, y, z, t = RoomSize.width_m / 2, RoomSize.depth_m / 2, RoomSize.height_m / 2, RoomSize.wall_m
    b.instance("floor").box((x, y, -t / 2), (RoomSize.width_m, RoomSize.depth_m, t), m.floor)
    b.instance("ceiling").box((x, y, RoomSize.height_m + t / 2), (RoomSize.width_m, RoomSize.depth_m, t), m.ceiling)
    walls: tuple[tuple[str, tuple[float, float], tuple[float, float], Material], ...] = (
        ("north wall", (x, RoomSize.depth_m + t / 2), (RoomSize.width_m, t), m.wallpaper),
        ("south wall", (x, -t / 2), (RoomSize.width_m, t), m.stripes),
        ("west wall", (-t / 2, y), (t, RoomSize.depth_m), m.plaster),
        ("east wall", (RoomSize.width_m + t / 2, y), (t, RoomSize.depth_m), m.brick),
    )
    for name, (cx, cy), (sx, sy), material in walls:
        wall = b.instance(name)
        wall.box((cx, cy, z), (sx, sy, RoomSize.height_m), material)
        inward = (np.sign(x - cx) if sx == t else 0.0, np.sign(y - cy) if sy == t else 0.0)
        skirting = (cx + inward[0] * (t / 2 + 0.008), cy + inward[1] * (t / 2 + 0.008), 0.05)
        wall.box(skirting, (0.016 if sx == t else sx, 0.016 if sy == t else sy, 0.10), m.white)
    lamp = b.instance("ceiling lamp", (2.6, 2.2, 0))
    lamp.cylinder((0, 0, 2.50), 0.008, 0.2, m.black)
    lamp.ellipsoid((0, 0, 2.30), (0.17, 0.17, 0.13), m.bulb, shadow=False)
    ring = [(2.6 + 0.13 * np.cos(a), 2.2 + 0.13 * np.sin(a), 2.3) for a in np.arange(6) * np.pi / 3]
    b.light(np.array(ring), (2.6, 2.35, 1.9))


def _lounge(b: SceneBuilder, m: Palette, rng: np.random.Generator) -> None:
    """Sofa, coffee table, rug, lamp, bookshelf and pictures along the north wall."""
    b.instance("rug", (1.95, 2.55, 0), 2).box((0, 0, 0.006), (2.5, 1.66, 0.012), m.rug)
    furniture.sofa(b, m, (1.95, 3.9, 0), 0)
    furniture.floor_lamp(b, m, (0.55, 3.95, 0))
    furniture.bookshelf(b, m, rng, (3.75, 4.23, 0), 0)
    furniture.plant(b, m, rng, (4.80, 3.95, 0))
    for painting, x, width, height in ((1, 1.25, 0.52, 0.52), (0, 2.0, 0.70, 0.52), (2, 2.72, 0.42, 0.58)):
        furniture.picture(b, m, m.paintings[painting], (x, RoomSize.depth_m, 1.62), 0, width, height)
    furniture.table(b, "coffee table", (1.95, 2.62, 0), 3, (1.15, 0.62, 0.42), m.walnut, m.walnut).box(
        (0, 0, 0.14), (0.98, 0.46, 0.025), m.walnut
    )
    furniture.fruit_bowl(b, m, (2.02, 2.68, 0.42))
    furniture.mug(b, m.mugs[0], m.coffee, (1.66, 2.48, 0.42), 200)
    furniture.mug(b, m.mugs[1], m.coffee, (2.36, 2.50, 0.42), -40)
    furniture.book_pile(b, m, rng, (1.62, 2.76, 0.42))
    furniture.book_pile(b, m, rng, (2.1, 2.6, 0.153), 2)
    b.instance("ball", (3.05, 2.95, 0)).ellipsoid((0, 0, 0.11), (0.11, 0.11, 0.11), m.football, (20, 30, 0))
    pouf = b.instance("pouf", (3.35, 3.42, 0))
    pouf.cylinder((0, 0, 0.19), 0.25, 0.38, m.mustard)
    pouf.ellipsoid((0, 0, 0.37), (0.25, 0.25, 0.06), m.mustard)


def _west_side(b: SceneBuilder, m: Palette, rng: np.random.Generator) -> None:
    """Window over a sideboard with things on it."""
    furniture.window(b, m, (0.0, 2.35, 1.55), 90)
    board = b.instance("sideboard", (0.24, 2.35, 0), 90)
    board.box((0, 0, 0.36), (1.5, 0.40, 0.52), m.oak, faces={2: m.drawers})
    board.box((0, 0, 0.63), (1.56, 0.44, 0.03), m.oak)
    for x in (-0.68, 0.68):
        board.box((x, 0, 0.05), (0.06, 0.34, 0.10), m.walnut)
    vase = b.instance("vase", (0.24, 2.85, 0.645))
    vase.ellipsoid((0, 0, 0.12), (0.085, 0.085, 0.12), m.vase)
    vase.cylinder((0, 0, 0.25), 0.035, 0.07, m.vase, top=1.5, cap=m.black)
    furniture.book_pile(b, m, rng, (0.24, 2.35, 0.645), 4)
    furniture.plant(b, m, rng, (0.22, 1.85, 0.645), 0.42)
    furniture.armchair(b, m, (0.72, 1.28, 0), 60)
    b.instance("beach ball", (1.18, 1.72, 0)).ellipsoid((0, 0, 0.15), (0.15, 0.15, 0.15), m.beach_ball, (35, 20, 0))


def _desk_corner(b: SceneBuilder, m: Palette, rng: np.random.Generator) -> None:
    """Desk with a computer before the brick wall."""
    desk = furniture.table(b, "desk", (4.82, 1.75, 0), -90, (1.5, 0.68, 0.74), m.pine, m.pine)
    desk.box((0.5, 0.0, 0.40), (0.36, 0.56, 0.52), m.pine, faces={2: m.desk_drawers})
    monitor = b.instance("monitor", (5.0, 1.8, 0.74), -90)
    monitor.box((0, 0.02, 0.008), (0.24, 0.18, 0.016), m.black)
    monitor.box((0, 0.05, 0.12), (0.05, 0.03, 0.22), m.black)
    monitor.box((0, 0.0, 0.33), (0.62, 0.03, 0.37), m.black)
    monitor.box((0, -0.017, 0.33), (0.59, 0.006, 0.34), m.black, faces={2: m.monitor})
    keyboard = b.instance("keyboard", (4.70, 1.8, 0.74), -90)
    keyboard.box((0, 0, 0.01), (0.42, 0.14, 0.02), m.grey_cloth)
    furniture.mug(b, m.mugs[2], m.coffee, (4.68, 1.36, 0.74), 70)
    lamp = b.instance("desk lamp", (4.98, 2.30, 0.74))
    lamp.cylinder((0, 0, 0.012), 0.08, 0.024, m.steel)
    lamp.cylinder((0, 0, 0.19), 0.01, 0.36, m.steel)
    lamp.cylinder((-0.09, -0.05, 0.38), 0.085, 0.12, m.rose, (0, 25, 0), top=0.5)
    furniture.book_pile(b, m, rng, (4.98, 1.22, 0.74), 3)
    furniture.chair(b, "desk chair", (4.28, 1.72, 0), 82, m.walnut, m.rose)
    furniture.picture(b, m, m.paintings[3], (RoomSize.width_m, 1.3, 1.68), -90, 0.56, 0.56)
    furniture.picture(b, m, m.paintings[4], (RoomSize.width_m, 2.15, 1.68), -90, 0.72, 0.50)
    clock = b.instance("clock", (RoomSize.width_m, 3.05, 1.80))
    clock.cylinder((-0.02, 0, 0), 0.16, 0.04, m.black, (0, -90, 0), cap=m.clock)
    basket = b.instance("waste basket", (4.92, 2.75, 0))
    basket.cylinder((0, 0, 0.16), 0.12, 0.32, m.wicker, top=1.2, cap=m.black)


def _south_side(b: SceneBuilder, m: Palette, rng: np.random.Generator) -> None:
    """Television, door and a round table in the corner."""
    stand = b.instance("television stand", (2.75, 0.24, 0), 180)
    stand.box((0, 0, 0.26), (1.5, 0.38, 0.40), m.walnut, faces={2: m.drawers})
    stand.box((0, 0, 0.03), (1.4, 0.30, 0.06), m.black)
    screen = b.instance("television", (2.75, 0.20, 0.46), 180)
    screen.box((0, 0, 0.02), (0.5, 0.2, 0.04), m.black)
    screen.box((0, 0, 0.38), (1.12, 0.04, 0.66), m.black)
    screen.box((0, -0.022, 0.38), (1.08, 0.006, 0.62), m.black, faces={2: m.television})
    door = b.instance("door", (4.35, 0.0, 0), 180)
    door.box((0, -0.02, 1.0), (0.86, 0.04, 2.0), m.white, faces={2: m.door})
    for x in (-0.46, 0.46):
        door.box((x, -0.025, 1.03), (0.08, 0.05, 2.06), m.white)
    door.box((0, -0.025, 2.05), (1.0, 0.05, 0.09), m.white)
    door.ellipsoid((0.34, -0.07, 1.0), (0.03, 0.03, 0.03), m.brass)
    top = b.instance("round table", (1.0, 0.52, 0))
    top.cylinder((0, 0, 0.72), 0.42, 0.035, m.oak)
    top.cylinder((0, 0, 0.36), 0.035, 0.70, m.walnut)
    top.cylinder((0, 0, 0.02), 0.22, 0.04, m.walnut, top=0.8)
    furniture.mug(b, m.mugs[1], m.coffee, (1.12, 0.60, 0.738), 30)
    laptop = b.instance("laptop", (0.92, 0.48, 0.738), 150)
    laptop.box((0, 0, 0.009), (0.33, 0.23, 0.018), m.steel)
    laptop.box((0, 0.135, 0.115), (0.33, 0.012, 0.22), m.steel, (-14, 0, 0), {2: m.laptop})
    furniture.chair(b, "chair", (1.62, 0.55, 0), -85, m.oak, m.grey_cloth)
    furniture.picture(b, m, m.paintings[1], (1.0, 0.0, 1.6), 180, 0.6, 0.6)
