# SPDX-License-Identifier: Apache-2.0
"""The materials of the house; each of its spaces looks different."""

from __future__ import annotations

import numpy as np

from ggslam.synthetic import pictures
from ggslam.synthetic.materials import MaterialMaker
from ggslam.synthetic.palette import Palette


class HousePalette(Palette):
    """All materials of the house, made once from a seed."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        make = MaterialMaker(np.random.default_rng([seed, 5]))
        # walls of rooms
        self.slate = make.limewash((0.42, 0.50, 0.58), 0.10)
        self.lilac = make.wallpaper((0.78, 0.72, 0.80), (0.50, 0.38, 0.56), 0.36)
        self.rosy = make.stripes((0.84, 0.70, 0.68), (0.76, 0.58, 0.58), 3, 0.9)
        self.sage = make.limewash((0.62, 0.70, 0.56), 0.08)
        self.wall_tiles = make.tiles((0.86, 0.88, 0.84), (0.72, 0.82, 0.80), (0.62, 0.62, 0.60), 4, 0.8)
        # walls of corridors: much to see, nothing to feel
        self.ochre = make.limewash((0.80, 0.64, 0.38), 0.14)
        self.panels = make.planks((0.34, 0.24, 0.18), (0.58, 0.42, 0.28), 6, 1.9)
        self.teal = make.limewash((0.36, 0.60, 0.60), 0.15)
        self.brickwork = make.bricks((0.66, 0.60, 0.52), (0.52, 0.48, 0.44), 1.6)
        # floors
        self.carpet = make.limewash((0.34, 0.36, 0.42), 0.20, 1.1)
        self.parquet = make.planks((0.58, 0.42, 0.24), (0.82, 0.66, 0.44), 12, 1.3)
        self.kitchen_floor = make.tiles((0.88, 0.86, 0.80), (0.24, 0.26, 0.28), (0.5, 0.5, 0.5), 4, 1.3)
        self.flagstones = make.tiles((0.58, 0.55, 0.50), (0.48, 0.46, 0.44), (0.34, 0.33, 0.32), 5, 2.1)
        self.clay = make.tiles((0.68, 0.40, 0.28), (0.58, 0.34, 0.25), (0.74, 0.70, 0.64), 8, 1.7)
        # furniture
        self.bedspread = make.rug((0.30, 0.36, 0.56), (0.86, 0.82, 0.70), (0.62, 0.28, 0.34))
        self.linen = make.fabric((0.88, 0.86, 0.80), 0.5)
        self.blue_rug = make.rug((0.18, 0.30, 0.42), (0.80, 0.80, 0.74), (0.76, 0.46, 0.22))
        self.runner = make.rug((0.26, 0.40, 0.26), (0.84, 0.76, 0.54), (0.54, 0.16, 0.16))
        self.cupboard = pictures.drawers(make, (0.86, 0.84, 0.76), 4, 1)
        self.counter_front = pictures.drawers(make, (0.44, 0.60, 0.58), 5, 2)
        self.wardrobe_front = pictures.door(make, (0.66, 0.50, 0.34))
        self.cabinet_front = pictures.drawers(make, (0.50, 0.54, 0.60), 1, 4)
        self.dresser_front = pictures.drawers(make, (0.70, 0.54, 0.40), 2, 3)
        self.worktop = make.limewash((0.30, 0.28, 0.27), 0.30, 0.5)
        self.whiteboard = pictures.diagram(make)
        self.posters = [
            pictures.abstract(make, [(0.12, 0.16, 0.24), (0.92, 0.78, 0.30), (0.80, 0.30, 0.28), (0.90, 0.90, 0.86)]),
            pictures.landscape(make, (0.86, 0.56, 0.50)),
            pictures.portrait(make, (0.30, 0.36, 0.50), (0.86, 0.62, 0.40)),
            pictures.abstract(make, [(0.90, 0.86, 0.80), (0.20, 0.44, 0.40), (0.88, 0.52, 0.24), (0.22, 0.20, 0.30)]),
            pictures.landscape(make, (0.40, 0.56, 0.86)),
            pictures.portrait(make, (0.62, 0.44, 0.40), (0.40, 0.56, 0.70)),
        ]
        self.second_window = pictures.landscape(make, (0.70, 0.80, 0.92), emission=1.9)
