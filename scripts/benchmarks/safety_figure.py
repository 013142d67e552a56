# SPDX-License-Identifier: Apache-2.0
"""Found and predicted speeds over latency, a panel for each voxel size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from safety_cells import Cell

from ggslam.reporting.plot_files import rasterize
from ggslam.reporting.plots import Plot, Series, draw


def draw_cells(cells: Sequence[Cell], distance: float, path: Path) -> None:
    """Writes the figure, two panels side by side."""
    voxels = sorted({cell.voxel for cell in cells}, reverse=True)
    panels = [rasterize(draw(_panel(cells, voxel, distance), 640, 380, titled=True)) for voxel in voxels]
    if len(panels) % 2:
        panels.append(np.full_like(panels[0], 255))
    rows = [np.concatenate(panels[k : k + 2], 1) for k in range(0, len(panels), 2)]
    cv2.imwrite(str(path), np.ascontiguousarray(np.concatenate(rows)[..., ::-1]))


def _panel(cells: Sequence[Cell], voxel: float, distance: float) -> Plot:
    mine = sorted((c for c in cells if c.voxel == voxel), key=lambda c: c.latency)
    x = [1e3 * cell.latency for cell in mine]
    series = (
        Series("predicted, waiting left out", x, [c.plain for c in mine], color=1, dashed=True),
        Series("predicted", x, [c.predicted for c in mine], color=0),
        Series(f"found: no collision in {mine[0].trials}", x, [c.found for c in mine], "dots", color=2),
    )
    took = 1e3 * mine[0].map_latency
    title = f"obstacles {distance:g} m ahead, voxels of {100 * voxel:g} cm (in the map after {took:.0f} ms)"
    return Plot(f"{100 * voxel:g}", title, "latency of sensor, map and plan, ms", "largest speed, m/s", series,
                from_zero=True)  # fmt: skip
