# SPDX-License-Identifier: Apache-2.0
"""Pieces of furniture, each a function that adds shapes of one or a few instances to a scene.

Own axes of a piece: origin on the floor at its middle, front towards -y.
"""

from __future__ import annotations

import numpy as np

from ggslam.synthetic.materials import Material
from ggslam.synthetic.palette import Palette
from ggslam.synthetic.scene import Placer, SceneBuilder, Vector


def table(b: SceneBuilder, name: str, at: Vector, turn: float, size: Vector, top: Material, legs: Material) -> Placer:
    """A table of full size (x, y, height) on four legs."""
    place = b.instance(name, at, turn)
    width, depth, height = size
    place.box((0, 0, height - 0.02), (width, depth, 0.04), top)
    place.box((0, 0, height - 0.07), (width - 0.1, depth - 0.1, 0.06), legs)
    for x in (-1, 1):
        for y in (-1, 1):
            foot = (x * (width / 2 - 0.06), y * (depth / 2 - 0.06), height / 2 - 0.03)
            place.box(foot, (0.06, 0.06, height - 0.06), legs)
    return place


def chair(b: SceneBuilder, name: str, at: Vector, turn: float, wood: Material, seat: Material) -> None:
    """A chair with a slatted back."""
    place = b.instance(name, at, turn)
    place.box((0, 0, 0.44), (0.44, 0.44, 0.04), wood)
    place.box((0, -0.01, 0.475), (0.40, 0.40, 0.04), seat)
    for x in (-0.195, 0.195):
        place.box((x, -0.195, 0.21), (0.045, 0.045, 0.42), wood)
        place.box((x, 0.2, 0.46), (0.045, 0.045, 0.92), wood, (-2, 0, 0))
    for z in (0.58, 0.72, 0.86):
        place.box((0, 0.205, z), (0.36, 0.025, 0.075), wood, (-2, 0, 0))
    place.box((0, -0.195, 0.2), (0.36, 0.025, 0.03), wood)


def sofa(b: SceneBuilder, m: Palette, at: Vector, turn: float, width: float = 2.0) -> None:
    """A sofa with rounded arms and separate cushions."""
    place = b.instance("sofa", at, turn)
    place.box((0, 0.03, 0.20), (width, 0.84, 0.22), m.sofa)
    place.box((0, 0.36, 0.50), (width - 0.1, 0.18, 0.62), m.sofa, (-8, 0, 0))
    for side in (-1, 1):
        x = side * (width / 2 - 0.09)
        place.box((x, 0.02, 0.36), (0.18, 0.86, 0.40), m.sofa)
        place.cylinder((x, 0.02, 0.56), 0.11, 0.86, m.sofa, (90, 0, 0))
    for x in (-1, 1):
        place.box((x * (width - 0.38) / 4, -0.06, 0.375), ((width - 0.40) / 2, 0.68, 0.15), m.sofa_seat)
        place.box((x * (width - 0.38) / 4, 0.23, 0.62), ((width - 0.42) / 2, 0.16, 0.40), m.sofa_seat, (-14, 0, 0))
        for y in (-0.34, 0.4):
            place.cylinder((x * (width / 2 - 0.1), y, 0.045), 0.025, 0.09, m.walnut)
    for x, material, angle in ((-0.66, m.mustard, 14.0), (0.62, m.pattern, -18.0)):
        pillow = b.instance("cushion", at, turn)
        pillow.box((x, 0.04, 0.63), (0.42, 0.11, 0.40), material, (-20, angle, 0.4 * angle))


def armchair(b: SceneBuilder, m: Palette, at: Vector, turn: float) -> None:
    """A round-armed chair with a cushion."""
    place = b.instance("armchair", at, turn)
    place.box((0, 0, 0.22), (0.76, 0.74, 0.24), m.armchair)
    place.box((0, -0.03, 0.39), (0.50, 0.62, 0.12), m.armchair)
    place.box((0, 0.31, 0.58), (0.72, 0.16, 0.60), m.armchair, (-10, 0, 0))
    for side in (-1, 1):
        place.box((side * 0.32, -0.02, 0.38), (0.13, 0.70, 0.32), m.armchair)
        place.cylinder((side * 0.32, -0.02, 0.55), 0.08, 0.70, m.armchair, (90, 0, 0))
        for y in (-0.3, 0.3):
            place.cylinder((side * 0.3, y, 0.05), 0.025, 0.10, m.walnut)
    pillow = b.instance("cushion", at, turn)
    pillow.box((0.02, 0.13, 0.60), (0.36, 0.11, 0.34), m.rose, (-18, 6, 4))


def bookshelf(
    b: SceneBuilder, m: Palette, rng: np.random.Generator, at: Vector, turn: float, width: float = 1.1
) -> None:
    """A tall open shelf filled with books and a few things."""
    place = b.instance("bookshelf", at, turn)
    height, depth = 1.95, 0.32
    for side in (-1, 1):
        place.box((side * (width / 2 - 0.0125), 0, height / 2), (0.025, depth, height), m.oak)
    place.box((0, depth / 2 - 0.01, height / 2), (width, 0.02, height), m.oak)
    levels = np.linspace(0.08, height - 0.0125, 6)
    for z in levels:
        place.box((0, 0, float(z)), (width - 0.02, depth, 0.025), m.oak)
    books = b.instance("books", at, turn)
    for row, board in enumerate(levels[:-1] + 0.0125):
        x = -width / 2 + 0.03
        end = (0.50, 0.44, 0.22, 0.50, 0.36)[row] * width
        while x < end - width * 0.02:
            thick, tall = float(rng.uniform(0.022, 0.055)), float(rng.uniform(0.20, 0.30))
            lean = 7.0 if rng.random() < 0.08 else 0.0
            cover = m.covers[int(rng.integers(len(m.covers)))]
            books.box((x + thick / 2 + 0.01, float(rng.uniform(-0.05, 0.0)), float(board) + tall / 2 + 0.003),
                      (thick, 0.20, tall), cover, (0, lean, 0), {5: m.pages})  # fmt: skip
            x += thick + (0.035 if lean else 0.003)
    globe = b.instance("globe", at, turn)
    globe.ellipsoid((0.36 * width, -0.02, float(levels[2]) + 0.17), (0.115, 0.115, 0.115), m.globe, (20, 0, 0))
    globe.cylinder((0.36 * width, -0.02, float(levels[2]) + 0.04), 0.05, 0.06, m.walnut, top=0.5)
    jar = b.instance("jar", at, turn)
    jar.cylinder((0.43 * width, -0.02, float(levels[4]) + 0.10), 0.06, 0.17, m.vase, top=0.8)
    jar.cylinder((0.43 * width, -0.02, float(levels[4]) + 0.195), 0.05, 0.02, m.walnut)


def floor_lamp(b: SceneBuilder, m: Palette, at: Vector) -> None:
    """A lamp with a conical shade; gives warm light."""
    place = b.instance("floor lamp", at)
    place.cylinder((0, 0, 0.015), 0.15, 0.03, m.black)
    place.cylinder((0, 0, 0.75), 0.014, 1.46, m.brass)
    place.cylinder((0, 0, 1.58), 0.21, 0.28, m.shade, top=0.62, shadow=False)
    x, y, z = at
    points = np.array([(x + 0.08 * np.cos(a), y + 0.08 * np.sin(a), z + 1.6) for a in np.arange(4) * np.pi / 2])
    b.light(points, (1.5, 1.05, 0.55))


def plant(b: SceneBuilder, m: Palette, rng: np.random.Generator, at: Vector, size: float = 1.0) -> None:
    """A pot with long leaves."""
    pot = b.instance("plant pot", at)
    pot.cylinder((0, 0, 0.17 * size), 0.14 * size, 0.34 * size, m.terracotta, top=1.3, cap=m.earth)
    leaves = b.instance("plant", at)
    for k in range(26):
        turn, rise = 137.5 * k + rng.uniform(-15, 15), 78 - 2.2 * k + rng.uniform(-6, 6)
        length = size * rng.uniform(0.20, 0.34)
        base, lift = np.array([0, 0, (0.36 + 0.03 * (26 - k) * 0.9) * size]), np.radians(rise)
        way = np.array([np.cos(np.radians(turn)) * np.cos(lift), np.sin(np.radians(turn)) * np.cos(lift), np.sin(lift)])
        centre = base + way * length
        leaves.ellipsoid((float(centre[0]), float(centre[1]), float(centre[2])),
                         (length, 0.055 * size, 0.012 * size), m.leaves[k % 3], (0, -rise, turn))  # fmt: skip
    leaves.cylinder((0, 0, 0.65 * size), 0.018 * size, 0.75 * size, m.walnut, top=0.6)


def mug(b: SceneBuilder, material: Material, inside: Material, at: Vector, turn: float = 0.0) -> None:
    """A mug with a handle."""
    place = b.instance("mug", at, turn)
    place.cylinder((0, 0, 0.05), 0.04, 0.10, material, top=1.06, cap=inside)
    place.box((0.054, 0, 0.075), (0.035, 0.012, 0.012), material)
    place.box((0.054, 0, 0.030), (0.035, 0.012, 0.012), material)
    place.box((0.070, 0, 0.0525), (0.012, 0.012, 0.057), material)


def book_pile(b: SceneBuilder, m: Palette, rng: np.random.Generator, at: Vector, count: int = 3) -> None:
    """Books lying on one another."""
    place = b.instance("book pile", at)
    top = 0.0
    for _ in range(count):
        thick = float(rng.uniform(0.025, 0.045))
        cover = m.covers[int(rng.integers(len(m.covers)))]
        edges = {0: m.pages, 2: m.pages, 3: m.pages}
        size = (float(rng.uniform(0.17, 0.24)), float(rng.uniform(0.24, 0.30)), thick)
        place.box((0, 0, top + thick / 2), size, cover, (0, 0, float(rng.uniform(-30, 30))), edges)
        top += thick


def fruit_bowl(b: SceneBuilder, m: Palette, at: Vector) -> None:
    """A shallow bowl of fruit."""
    bowl = b.instance("fruit bowl", at)
    bowl.cylinder((0, 0, 0.035), 0.08, 0.07, m.porcelain, top=1.85)
    fruit = b.instance("fruit", at)
    spots = (m.orange, 0.07, 20), (m.apple, 0.07, 95), (m.orange, 0.075, 165), (m.pear, 0.07, 240), (m.apple, 0.07, 310)
    for material, radius, angle in spots:
        x, y = radius * np.cos(np.radians(angle)), radius * np.sin(np.radians(angle))
        fruit.ellipsoid((float(x), float(y), 0.085), (0.042, 0.042, 0.041), material)
    fruit.ellipsoid((0, 0, 0.13), (0.041, 0.041, 0.04), m.orange)


def picture(
    b: SceneBuilder, m: Palette, painting: Material, at: Vector, turn: float, width: float, height: float
) -> None:
    """A framed picture; `at` is its centre on the wall, front towards -y."""
    place = b.instance("picture", at, turn)
    place.box((0, -0.008, 0), (width, 0.016, height), m.white, faces={2: painting})
    for x in (-1, 1):
        place.box((x * width / 2, -0.015, 0), (0.035, 0.03, height + 0.035), m.walnut)
    for z in (-1, 1):
        place.box((0, -0.015, z * height / 2), (width, 0.03, 0.035), m.walnut)


def window(b: SceneBuilder, m: Palette, at: Vector, turn: float, width: float = 1.7, height: float = 1.3) -> None:
    """A window with a view, a sill and curtains; daylight comes from it. `at` is its centre on the wall."""
    place = b.instance("window", at, turn)
    place.box((0, 0.0, 0), (width, 0.01, height), m.white, faces={2: m.window})
    for x in (-width / 2, -width / 6, width / 6, width / 2):
        place.box((x, -0.03, 0), (0.05, 0.06, height + 0.05), m.white)
    for z in (-height / 2, height * 0.18, height / 2):
        place.box((0, -0.03, z), (width + 0.05, 0.05, 0.05), m.white)
    place.box((0, -0.10, -height / 2 - 0.04), (width + 0.2, 0.22, 0.03), m.white)
    curtains = b.instance("curtains", at, turn)
    for x in (-1, 1):
        curtains.box((x * (width / 2 + 0.16), -0.09, -0.05), (0.42, 0.06, height + 0.55), m.curtain)
    curtains.cylinder((0, -0.10, height / 2 + 0.24), 0.016, width + 0.95, m.brass, (0, 90, 0))
    grid = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 4), [-0.05], np.linspace(-0.35, 0.35, 3)), -1).reshape(-1, 3)
    T = place.T_world_own
    points = (grid * (width, 1, height) - (0, 0.08, 0)) @ T[:3, :3].T + T[:3, 3]
    normal = -T[:3, 1]
    b.light(points, (3.6, 3.8, 4.2), (float(normal[0]), float(normal[1]), float(normal[2])))
