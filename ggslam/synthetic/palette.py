# SPDX-License-Identifier: Apache-2.0
"""The materials of the furnished room."""

from __future__ import annotations

import numpy as np

from ggslam.synthetic import pictures
from ggslam.synthetic.materials import Material, MaterialMaker

_CLOTH = np.array(
    [(0.50, 0.16, 0.14), (0.14, 0.22, 0.38), (0.16, 0.32, 0.24), (0.55, 0.40, 0.20), (0.30, 0.20, 0.14),
     (0.70, 0.64, 0.52), (0.22, 0.24, 0.27), (0.66, 0.34, 0.18), (0.28, 0.42, 0.48), (0.42, 0.20, 0.32)]
)  # fmt: skip
"""Colours of book covers."""
_PRINT = np.array([(0.86, 0.76, 0.46), (0.90, 0.88, 0.82), (0.14, 0.13, 0.14), (0.72, 0.28, 0.20)])
"""Colours of the bands on them."""


class Palette:
    """All materials, made once from a seed."""

    def __init__(self, seed: int) -> None:
        make = MaterialMaker(np.random.default_rng([seed, 1]))
        self._make_shell(make)
        self._make_hard(make)
        self._make_cloth(make)
        self._make_pictures(make)
        self._make_small(make)

    def _make_shell(self, make: MaterialMaker) -> None:
        """Floor, walls, ceiling."""
        self.floor = make.planks((0.36, 0.23, 0.14), (0.66, 0.48, 0.31))
        self.ceiling = make.plaster((0.90, 0.89, 0.86))
        self.wallpaper = make.wallpaper((0.80, 0.77, 0.68), (0.52, 0.62, 0.58))
        self.plaster = make.plaster((0.86, 0.79, 0.66))
        self.brick = make.bricks((0.60, 0.33, 0.25), (0.72, 0.69, 0.64))
        self.stripes = make.stripes((0.62, 0.70, 0.76), (0.74, 0.80, 0.83))
        self.white = make.plain((0.90, 0.89, 0.87))

    def _make_hard(self, make: MaterialMaker) -> None:
        """Wood, metal, stone."""
        self.oak = make.wood((0.55, 0.37, 0.21), (0.78, 0.59, 0.37))
        self.walnut = make.wood((0.25, 0.15, 0.09), (0.47, 0.31, 0.20))
        self.pine = make.wood((0.74, 0.58, 0.36), (0.90, 0.77, 0.55))
        self.black = make.plain((0.10, 0.10, 0.11), 0.06)
        self.steel = make.plain((0.62, 0.63, 0.66), 0.05)
        self.brass = make.plain((0.72, 0.56, 0.26), 0.06)
        self.terracotta = make.plain((0.70, 0.38, 0.25), 0.08, 0.3)
        self.earth = make.plain((0.22, 0.15, 0.10), 0.3, 0.12)
        self.porcelain = make.plain((0.90, 0.90, 0.91), 0.03)

    def _make_cloth(self, make: MaterialMaker) -> None:
        """Cloth and wickerwork."""
        self.sofa = make.fabric((0.24, 0.40, 0.46))
        self.sofa_seat = make.fabric((0.30, 0.48, 0.54))
        self.mustard = make.fabric((0.84, 0.62, 0.20))
        self.rose = make.fabric((0.78, 0.42, 0.40))
        self.armchair = make.fabric((0.66, 0.36, 0.22))
        self.grey_cloth = make.fabric((0.48, 0.48, 0.50))
        self.pattern = make.checker((0.88, 0.84, 0.76), (0.28, 0.34, 0.45), 6)
        self.curtain = make.folds((0.72, 0.28, 0.24))
        self.rug = make.rug((0.58, 0.20, 0.18), (0.88, 0.78, 0.60), (0.16, 0.22, 0.38))
        self.wicker = make.checker((0.70, 0.53, 0.33), (0.52, 0.36, 0.20), 24)

    def _make_pictures(self, make: MaterialMaker) -> None:
        """Pictures, screens, fronts."""
        self.window = pictures.landscape(make, (0.52, 0.72, 0.95), emission=1.9)
        self.paintings = [
            pictures.landscape(make, (0.95, 0.70, 0.45)),
            pictures.abstract(make, [(0.93, 0.90, 0.82), (0.85, 0.30, 0.22), (0.16, 0.30, 0.50), (0.93, 0.70, 0.22)]),
            pictures.portrait(make, (0.45, 0.52, 0.42), (0.70, 0.75, 0.85)),
            pictures.abstract(make, [(0.20, 0.26, 0.34), (0.80, 0.84, 0.80), (0.30, 0.60, 0.58), (0.90, 0.55, 0.35)]),
            pictures.landscape(make, (0.60, 0.74, 0.82)),
        ]
        self.monitor = pictures.screen(make, (0.12, 0.14, 0.19))
        self.laptop = pictures.screen(make, (0.93, 0.93, 0.95))
        self.television = pictures.landscape(make, (0.30, 0.45, 0.70), emission=0.8)
        self.door = pictures.door(make, (0.88, 0.86, 0.80))
        self.drawers = pictures.drawers(make, (0.66, 0.48, 0.30), 3, 2)
        self.desk_drawers = pictures.drawers(make, (0.80, 0.66, 0.44), 1, 3)
        self.clock = pictures.clock(make)
        self.globe = pictures.globe(make)

    def _make_small(self, make: MaterialMaker) -> None:
        """Lamps, plants, fruit, toys, dishes, books."""
        self.shade = make.plain((0.99, 0.90, 0.70), 0.04, emission=1.25)
        self.bulb = make.plain((0.99, 0.96, 0.88), 0.01, emission=2.2)
        self.leaves = [make.plain((0.16 + 0.05 * k, 0.38 + 0.08 * k, 0.15), 0.22, 0.1) for k in range(3)]
        self.orange = make.plain((0.93, 0.52, 0.13), 0.08, 0.05)
        self.apple = make.plain((0.74, 0.16, 0.14), 0.14, 0.08)
        self.pear = make.plain((0.72, 0.74, 0.26), 0.10, 0.06)
        self.coffee = make.plain((0.18, 0.10, 0.06), 0.03)
        self.pages = make.stripes((0.90, 0.87, 0.78), (0.80, 0.76, 0.66), 24, 0.06)
        self.football = make.checker((0.92, 0.92, 0.90), (0.12, 0.12, 0.14), 10)
        self.beach_ball = make.bands([(0.90, 0.25, 0.2), (0.95, 0.95, 0.9), (0.2, 0.45, 0.8), (0.95, 0.8, 0.25)])
        self.mugs = [
            make.bands([(0.22, 0.42, 0.62), (0.92, 0.92, 0.90), (0.22, 0.42, 0.62)]),
            make.bands([(0.86, 0.80, 0.70), (0.74, 0.34, 0.22), (0.86, 0.80, 0.70), (0.74, 0.34, 0.22)]),
            make.bands([(0.30, 0.55, 0.35), (0.85, 0.90, 0.80)]),
        ]
        self.vase = make.bands([(0.16, 0.30, 0.45), (0.80, 0.82, 0.80), (0.25, 0.48, 0.60), (0.80, 0.82, 0.80)])
        self.covers = [self._cover(make) for _ in range(20)]

    @staticmethod
    def _cover(make: MaterialMaker) -> Material:
        """A book cover: one colour with two bands of another."""
        base = _CLOTH[make.rng.integers(len(_CLOTH))] * make.rng.uniform(0.8, 1.2)
        other = _PRINT[make.rng.integers(len(_PRINT))]
        a, b = (float(base[0]), float(base[1]), float(base[2])), (float(other[0]), float(other[1]), float(other[2]))
        return make.bands([a, b, a, b, a])
