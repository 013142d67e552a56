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
from ggslam.volumes.safety import Braking, Latencies


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
    first = mine[0]
    x = np.linspace(first.map_latency, max(0.52, 1.1 * mine[-1].latency), 100)
    curves = [
        [_braking(first, latency + waiting).largest_speed(distance) for latency in x]
        for waiting in (0.0, first.total - first.latency)
    ]
    series = (
        Series("predicted, waiting left out", 1e3 * x, curves[0], color=1, dashed=True),
        Series("predicted", 1e3 * x, curves[1], color=0),
        Series(f"found: no collision in {first.trials}", [1e3 * c.latency for c in mine], [c.found for c in mine],
               "dots", color=2),
    )  # fmt: skip
    took = f"voxels of {100 * voxel:g} cm (in the map after {1e3 * first.map_latency:.0f} ms)"
    return Plot(f"{100 * voxel:g}", f"obstacles {distance:g} m ahead, {took}", "latency of sensor, map and plan, ms",
                "largest speed, m/s", series, from_zero=True)  # fmt: skip


def _braking(cell: Cell, seconds: float) -> Braking:
    """The robot of a cell after another blind time."""
    return Braking(Latencies(sensor=seconds, map=0.0, plan=0.0), cell.friction, cell.braked_share)
