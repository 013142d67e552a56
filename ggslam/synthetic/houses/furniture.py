# SPDX-License-Identifier: Apache-2.0
"""Furniture of the bedroom, the kitchen and the study. Own axes as in `furniture`: front towards -y."""

from __future__ import annotations

from ggslam.synthetic.houses.palette import HousePalette
from ggslam.synthetic.materials import Material
from ggslam.synthetic.scene import SceneBuilder, Vector


def bed(b: SceneBuilder, m: HousePalette, at: Vector, turn: float, width: float = 1.6) -> None:
    """A double bed, 2 m long, its head at the back."""
    place = b.instance("bed", at, turn)
    place.box((0, 0, 0.19), (width, 2.0, 0.20), m.walnut)
    place.box((0, 1.0, 0.55), (width + 0.08, 0.06, 1.0), m.walnut)
    place.box((0, 0, 0.40), (width - 0.06, 1.94, 0.24), m.linen)
    for x in (-width / 2 + 0.06, width / 2 - 0.06):
        for y in (-0.94, 0.9):
            place.box((x, y, 0.045), (0.07, 0.07, 0.09), m.walnut)
    cover = b.instance("bedspread", at, turn)
    cover.box((0, -0.28, 0.475), (width + 0.02, 1.42, 0.11), m.bedspread)
    for x, material in ((-0.38, m.linen), (0.38, m.rose)):
        pillow = b.instance("pillow", at, turn)
        pillow.box((x, 0.68, 0.60), (0.62, 0.40, 0.15), material, (14, 0, 3 * x))


def night_table(b: SceneBuilder, m: HousePalette, at: Vector, turn: float) -> None:
    """A small chest with a lamp that gives a little warm light."""
    place = b.instance("night table", at, turn)
    place.box((0, 0, 0.27), (0.42, 0.36, 0.46), m.pine, faces={2: m.desk_drawers})
    place.box((0, 0, 0.515), (0.46, 0.40, 0.03), m.oak)
    lamp = b.instance("bedside lamp", (at[0], at[1], at[2] + 0.53))
    lamp.ellipsoid((0, 0, 0.09), (0.07, 0.07, 0.09), m.vase)
    lamp.cylinder((0, 0, 0.27), 0.12, 0.18, m.shade, top=0.7, shadow=False)


def wardrobe(b: SceneBuilder, m: HousePalette, at: Vector, turn: float, doors: int = 2) -> None:
    """A wardrobe, 2.1 m high, with panelled doors of 55 cm."""
    place = b.instance("wardrobe", at, turn)
    width = 0.55 * doors
    place.box((0, 0, 1.05), (width + 0.06, 0.56, 1.98), m.oak)
    place.box((0, 0, 0.03), (width, 0.50, 0.06), m.walnut)
    place.box((0, -0.01, 2.07), (width + 0.12, 0.62, 0.06), m.walnut)
    for i in range(doors):
        x = -width / 2 + 0.55 * (i + 0.5)
        place.box((x, -0.29, 1.06), (0.53, 0.02, 1.90), m.oak, faces={2: m.wardrobe_front})
        place.ellipsoid((x + (0.2 if i % 2 == 0 else -0.2), -0.32, 1.05), (0.02, 0.02, 0.02), m.brass)


def chest(b: SceneBuilder, name: str, at: Vector, turn: float, size: Vector, front: Material, body: Material) -> None:
    """A chest of drawers or a cabinet of full size (x, y, height)."""
    place = b.instance(name, at, turn)
    width, depth, height = size
    place.box((0, 0, height / 2 + 0.03), (width, depth, height - 0.06), body, faces={2: front})
    place.box((0, -0.01, height - 0.015), (width + 0.04, depth + 0.03, 0.03), body)
    place.box((0, 0.02, 0.03), (width - 0.06, depth - 0.06, 0.06), body)


def kitchen_row(b: SceneBuilder, m: HousePalette, at: Vector, turn: float, width: float) -> None:
    """Counter with worktop, sink and stove, cupboards on the wall above."""
    counter = b.instance("counter", at, turn)
    counter.box((0, 0.02, 0.45), (width, 0.56, 0.82), m.white, faces={2: m.counter_front})
    counter.box((0, 0, 0.88), (width + 0.02, 0.62, 0.04), m.worktop)
    above = b.instance("wall cupboards", at, turn)
    above.box((-0.25 * width, 0.13, 1.85), (0.5 * width, 0.34, 0.66), m.white, faces={2: m.cupboard})
    above.box((0.38 * width, 0.13, 1.85), (0.24 * width, 0.34, 0.66), m.white, faces={2: m.wardrobe_front})
    hood = b.instance("extractor hood", at, turn)
    hood.box((0.13 * width, 0.16, 1.66), (0.24 * width, 0.28, 0.10), m.steel)
    hood.box((0.13 * width, 0.18, 1.98), (0.22, 0.22, 0.60), m.steel)
    stove = b.instance("stove", at, turn)
    stove.box((0.13 * width, -0.02, 0.905), (0.56, 0.48, 0.012), m.black)
    for x, y in ((-0.13, -0.12), (0.13, -0.12), (-0.13, 0.10), (0.13, 0.10)):
        stove.cylinder((0.13 * width + x, y - 0.02, 0.915), 0.075, 0.012, m.steel)
    pot = b.instance("pot", at, turn)
    pot.cylinder((0.13 * width - 0.13, 0.08, 0.99), 0.10, 0.14, m.brass, cap=m.black)
    kettle = b.instance("kettle", at, turn)
    kettle.ellipsoid((-0.06 * width, 0.08, 1.0), (0.09, 0.09, 0.10), m.steel)
    kettle.cylinder((-0.06 * width, 0.08, 1.11), 0.03, 0.03, m.black)
    tap = b.instance("tap", at, turn)
    tap.cylinder((-0.27 * width, 0.20, 1.05), 0.015, 0.30, m.steel)
    tap.box((-0.27 * width, 0.11, 1.19), (0.025, 0.20, 0.025), m.steel)
    bread = b.instance("bread", at, turn)
    bread.box((0.40 * width, 0.0, 0.91), (0.36, 0.24, 0.02), m.pine)
    bread.ellipsoid((0.40 * width, 0.0, 0.97), (0.14, 0.075, 0.055), m.terracotta)


def refrigerator(b: SceneBuilder, m: HousePalette, at: Vector, turn: float) -> None:
    """A tall refrigerator with notes on its door."""
    place = b.instance("refrigerator", at, turn)
    place.box((0, 0, 0.92), (0.62, 0.62, 1.80), m.steel)
    place.box((0, -0.32, 0.62), (0.61, 0.03, 1.16), m.porcelain)
    place.box((0, -0.32, 1.52), (0.61, 0.03, 0.60), m.porcelain)
    for z in (1.0, 1.45):
        place.box((0.25, -0.35, z), (0.03, 0.03, 0.26), m.black)
    notes = b.instance("notes", at, turn)
    for x, z, poster in ((-0.12, 1.56, 0), (0.08, 1.48, 3), (-0.05, 0.95, 5)):
        notes.box((x, -0.337, z), (0.14, 0.006, 0.17), m.white, faces={2: m.posters[poster]})


def whiteboard(b: SceneBuilder, m: HousePalette, at: Vector, turn: float, width: float, height: float) -> None:
    """A framed whiteboard; `at` is its centre on the wall."""
    place = b.instance("whiteboard", at, turn)
    place.box((0, -0.01, 0), (width, 0.02, height), m.white, faces={2: m.whiteboard})
    for z in (-1, 1):
        place.box((0, -0.015, z * height / 2), (width + 0.03, 0.03, 0.03), m.steel)
    place.box((0, -0.05, -height / 2 - 0.01), (0.5, 0.08, 0.015), m.steel)
