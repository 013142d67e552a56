# SPDX-License-Identifier: Apache-2.0
"""What stands in the spaces of the house; see `house` for their places."""

from __future__ import annotations

import numpy as np

from ggslam.synthetic import furniture
from ggslam.synthetic.houses import furniture as house_furniture
from ggslam.synthetic.houses.palette import HousePalette
from ggslam.synthetic.scene import SceneBuilder, Vector


def ceiling_lamp(b: SceneBuilder, m: HousePalette, x: float, y: float, power: Vector = (2.6, 2.35, 1.9)) -> None:
    """A hanging lamp; light comes from a ring of points in it."""
    lamp = b.instance("ceiling lamp", (x, y, 0))
    lamp.cylinder((0, 0, 2.50), 0.008, 0.2, m.black)
    lamp.ellipsoid((0, 0, 2.32), (0.16, 0.16, 0.12), m.bulb, shadow=False)
    b.light(np.array([(x + 0.13 * np.cos(a), y + 0.13 * np.sin(a), 2.32) for a in np.arange(4) * np.pi / 2]), power)


def living_room(b: SceneBuilder, m: HousePalette, rng: np.random.Generator) -> None:
    """x 0 to 4.6, y 0 to 4; doors in the middle of the north and the east wall."""
    ceiling_lamp(b, m, 2.3, 1.5)
    b.instance("rug", (1.75, 1.35, 0), 2).box((0, 0, 0.006), (2.3, 1.5, 0.012), m.rug)
    furniture.sofa(b, m, (1.75, 0.5, 0), 180)
    furniture.floor_lamp(b, m, (0.4, 0.42, 0))
    furniture.table(b, "coffee table", (1.55, 1.55, 0), 4, (1.0, 0.55, 0.42), m.walnut, m.walnut)
    furniture.fruit_bowl(b, m, (1.7, 1.6, 0.42))
    furniture.mug(b, m.mugs[0], m.coffee, (1.25, 1.45, 0.42), 200)
    furniture.book_pile(b, m, rng, (1.38, 1.68, 0.42))
    for painting, x, width, height in ((1, 1.05, 0.52, 0.52), (0, 1.75, 0.70, 0.52), (2, 2.45, 0.42, 0.58)):
        furniture.picture(b, m, m.paintings[painting], (x, 0.0, 1.62), 180, width, height)
    furniture.plant(b, m, rng, (3.2, 0.42, 0))
    house_furniture.chest(b, "television stand", (4.34, 0.72, 0), -90, (1.2, 0.40, 0.48), m.drawers, m.walnut)
    screen = b.instance("television", (4.38, 0.72, 0.48), -90)
    screen.box((0, 0, 0.02), (0.5, 0.2, 0.04), m.black)
    screen.box((0, 0, 0.36), (1.04, 0.04, 0.62), m.black)
    screen.box((0, -0.022, 0.36), (1.0, 0.006, 0.58), m.black, faces={2: m.television})
    furniture.window(b, m, (0.0, 1.9, 1.55), 90, 1.5)
    house_furniture.chest(b, "sideboard", (0.24, 1.9, 0), 90, (1.4, 0.40, 0.62), m.drawers, m.oak)
    vase = b.instance("vase", (0.24, 2.35, 0.62))
    vase.ellipsoid((0, 0, 0.12), (0.085, 0.085, 0.12), m.vase)
    vase.cylinder((0, 0, 0.25), 0.035, 0.07, m.vase, top=1.5, cap=m.black)
    furniture.book_pile(b, m, rng, (0.24, 1.85, 0.62), 4)
    furniture.armchair(b, m, (0.72, 3.3, 0), 50)
    furniture.bookshelf(b, m, rng, (3.75, 3.82, 0), 0)
    b.instance("beach ball", (3.75, 3.1, 0)).ellipsoid((0, 0, 0.15), (0.15, 0.15, 0.15), m.beach_ball, (35, 20, 0))
    clock = b.instance("clock", (4.6, 3.2, 1.85))
    clock.cylinder((-0.02, 0, 0), 0.16, 0.04, m.black, (0, -90, 0), cap=m.clock)


def study(b: SceneBuilder, m: HousePalette, rng: np.random.Generator) -> None:
    """x 10.4 to 14.4, y 0 to 3.9; doors in the west (y 2) and the north wall (x 12.45)."""
    ceiling_lamp(b, m, 12.4, 1.9)
    desk = furniture.table(b, "desk", (14.02, 1.6, 0), -90, (1.6, 0.70, 0.74), m.pine, m.pine)
    desk.box((0.52, 0.0, 0.40), (0.36, 0.56, 0.52), m.pine, faces={2: m.desk_drawers})
    for y, turn in ((1.22, -82), (1.98, -98)):
        monitor = b.instance("monitor", (14.16, y, 0.74), turn)
        monitor.box((0, 0.02, 0.008), (0.24, 0.18, 0.016), m.black)
        monitor.box((0, 0.05, 0.12), (0.05, 0.03, 0.22), m.black)
        monitor.box((0, 0.0, 0.33), (0.62, 0.03, 0.37), m.black)
        monitor.box((0, -0.017, 0.33), (0.59, 0.006, 0.34), m.black, faces={2: m.monitor})
    b.instance("keyboard", (13.86, 1.62, 0.74), -90).box((0, 0, 0.01), (0.42, 0.14, 0.02), m.grey_cloth)
    furniture.mug(b, m.mugs[2], m.coffee, (13.84, 1.2, 0.74), 70)
    furniture.book_pile(b, m, rng, (14.1, 2.3, 0.74), 3)
    furniture.chair(b, "desk chair", (13.42, 1.55, 0), 80, m.walnut, m.rose)
    furniture.picture(b, m, m.paintings[3], (14.4, 0.95, 1.75), -90, 0.56, 0.56)
    furniture.picture(b, m, m.posters[0], (14.4, 1.9, 1.75), -90, 0.80, 0.60)
    furniture.window(b, m, (14.4, 3.1, 1.55), -90, 0.9, 1.2)
    house_furniture.whiteboard(b, m, (11.9, 0.0, 1.55), 180, 1.6, 1.0)
    house_furniture.chest(b, "filing cabinet", (13.4, 0.3, 0), 180, (0.5, 0.5, 1.3), m.cabinet_front, m.steel)
    furniture.plant(b, m, rng, (13.4, 0.28, 1.3), 0.5)
    house_furniture.chest(b, "low cabinet", (11.6, 0.24, 0), 180, (1.3, 0.42, 0.72), m.cupboard, m.pine)
    globe = b.instance("globe", (11.3, 0.24, 0.72))
    globe.ellipsoid((0, 0, 0.17), (0.13, 0.13, 0.13), m.globe, (20, 0, 0))
    globe.cylinder((0, 0, 0.03), 0.06, 0.06, m.walnut, top=0.5)
    furniture.book_pile(b, m, rng, (11.95, 0.24, 0.72), 4)
    house_furniture.chest(b, "drawing cabinet", (11.15, 3.58, 0), 0, (1.1, 0.55, 0.95), m.desk_drawers, m.oak)
    furniture.picture(b, m, m.posters[2], (11.1, 3.9, 1.65), 0, 0.5, 0.7)
    furniture.armchair(b, m, (13.85, 3.35, 0), -45)
    basket = b.instance("waste basket", (14.1, 0.5, 0))
    basket.cylinder((0, 0, 0.16), 0.12, 0.32, m.wicker, top=1.2, cap=m.black)
    b.instance("blue rug", (12.3, 1.7, 0), 90).box((0, 0, 0.006), (1.5, 1.0, 0.012), m.blue_rug)


def bedroom(b: SceneBuilder, m: HousePalette, rng: np.random.Generator) -> None:
    """x 10.1 to 14.4, y 6.6 to 10.4; doors in the south (x 12.45) and the west wall (y 8.45)."""
    ceiling_lamp(b, m, 12.3, 8.3, (2.2, 2.0, 1.7))
    house_furniture.bed(b, m, (12.5, 9.4, 0), 0)
    for x in (11.4, 13.6):
        house_furniture.night_table(b, m, (x, 10.2, 0), 0)
    house_furniture.wardrobe(b, m, (14.1, 7.75, 0), -90, 3)
    furniture.window(b, m, (14.4, 9.45, 1.6), -90, 1.0, 1.2)
    house_furniture.chest(b, "dresser", (10.95, 6.86, 0), 180, (1.3, 0.46, 0.86), m.dresser_front, m.pine)
    jar = b.instance("jar", (10.6, 6.85, 0.86))
    jar.cylinder((0, 0, 0.09), 0.07, 0.18, m.vase, top=0.7, cap=m.black)
    furniture.book_pile(b, m, rng, (11.25, 6.85, 0.86), 2)
    furniture.picture(b, m, m.posters[1], (10.95, 6.6, 1.6), 180, 0.9, 0.6)
    furniture.picture(b, m, m.posters[5], (12.1, 10.4, 1.75), 0, 0.45, 0.6)
    furniture.picture(b, m, m.posters[3], (12.85, 10.4, 1.75), 0, 0.55, 0.55)
    furniture.chair(b, "bedroom chair", (10.5, 9.9, 0), 40, m.oak, m.mustard)
    furniture.plant(b, m, rng, (10.5, 7.6, 0), 0.8)
    pouf = b.instance("pouf", (13.5, 7.2, 0))
    pouf.cylinder((0, 0, 0.19), 0.24, 0.38, m.mustard)
    pouf.ellipsoid((0, 0, 0.37), (0.24, 0.24, 0.06), m.mustard)
    b.instance("bedroom rug", (11.6, 8.0, 0), 20).box((0, 0, 0.006), (1.7, 1.1, 0.012), m.runner)


def kitchen(b: SceneBuilder, m: HousePalette, rng: np.random.Generator) -> None:
    """x 0 to 4.3, y 6.5 to 10.4; doors in the east (y 8.45) and the south wall (x 2.25)."""
    ceiling_lamp(b, m, 2.1, 8.4)
    house_furniture.kitchen_row(b, m, (2.15, 10.08, 0), 0, 2.8)
    house_furniture.refrigerator(b, m, (0.34, 10.05, 0), 0)
    furniture.window(b, m, (0.0, 8.9, 1.6), 90, 1.1, 1.1)
    furniture.table(b, "kitchen table", (0.75, 7.75, 0), 90, (1.3, 0.8, 0.75), m.oak, m.white)
    furniture.fruit_bowl(b, m, (0.7, 7.9, 0.75))
    furniture.mug(b, m.mugs[1], m.coffee, (0.95, 7.4, 0.75), 30)
    furniture.mug(b, m.mugs[0], m.coffee, (0.55, 8.2, 0.75), 120)
    furniture.chair(b, "kitchen chair", (1.35, 7.55, 0), -80, m.white, m.mustard)
    furniture.chair(b, "kitchen chair", (0.8, 8.75, 0), 10, m.white, m.grey_cloth)
    furniture.picture(b, m, m.posters[4], (0.0, 7.4, 1.65), 90, 0.7, 0.5)
    house_furniture.chest(b, "dresser", (3.7, 6.74, 0), 180, (1.0, 0.42, 0.90), m.drawers, m.pine)
    furniture.plant(b, m, rng, (3.9, 6.72, 0.90), 0.45)
    jar = b.instance("jar", (3.45, 6.72, 0.90))
    jar.cylinder((0, 0, 0.10), 0.06, 0.20, m.mugs[2], top=0.8, cap=m.walnut)
    furniture.picture(b, m, m.paintings[4], (3.65, 6.5, 1.65), 180, 0.8, 0.6)
    furniture.picture(b, m, m.posters[0], (4.3, 9.45, 1.6), -90, 0.5, 0.5)
    clock = b.instance("kitchen clock", (0.9, 6.5, 1.85))
    clock.cylinder((0, 0.02, 0), 0.15, 0.04, m.black, (-90, 0, 0), cap=m.clock)
    basket = b.instance("basket", (4.0, 9.75, 0))
    basket.cylinder((0, 0, 0.18), 0.17, 0.36, m.wicker, top=1.15, cap=m.earth)
    b.instance("kitchen mat", (2.3, 9.2, 0)).box((0, 0, 0.006), (1.4, 0.6, 0.012), m.blue_rug)


def corridors(b: SceneBuilder, m: HousePalette) -> None:
    """Lamps; a few pictures, which are flat. Nothing stands on the floor."""
    for x, y in ((6.3, 2.0), (8.8, 2.0), (5.9, 8.45), (8.5, 8.45), (12.45, 5.25), (2.25, 5.25)):
        ceiling_lamp(b, m, x, y, (1.5, 1.35, 1.1))
    furniture.picture(b, m, m.posters[5], (6.2, 2.8, 1.55), 0, 0.5, 0.7)
    furniture.picture(b, m, m.posters[1], (8.4, 1.2, 1.55), 180, 0.8, 0.55)
    furniture.picture(b, m, m.posters[3], (7.9, 9.2, 1.55), 0, 0.6, 0.6)
    furniture.picture(b, m, m.paintings[2], (5.6, 7.7, 1.55), 180, 0.45, 0.6)
    furniture.picture(b, m, m.posters[2], (13.2, 5.3, 1.55), -90, 0.5, 0.7)
    furniture.picture(b, m, m.posters[4], (1.5, 5.2, 1.55), 90, 0.7, 0.5)
