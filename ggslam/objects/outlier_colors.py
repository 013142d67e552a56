# SPDX-License-Identifier: Apache-2.0
"""Colours that a plane has at one place only. A wallpaper, a chequered floor or the grain of a table top is made of
many colours, all of which come again all over the plane; those of a picture or of a rug do not."""

from __future__ import annotations

from typing import Final

import numpy as np

from ggslam.objects.pixel_passes import outlier_colors
from ggslam.system.tuning import Tuning

BRIGHTNESS: Final = 1
"""Code of a piece that differs in brightness; the compiled core gives it."""
HUE: Final = 2
"""Code of a piece that differs in hue."""


class OutlierColorTuning(Tuning):
    """Which colours occur at one place of a plane only."""

    cells = 12
    """Cells across the image in which colours are counted."""
    brightness_bin = 1.0
    """Width of bins of L, as a share of the contrast."""
    hue_bin = 0.5
    """Width of bins of a and b, as a share of the contrast."""
    min_contrast = 8.0
    """Smallest contrast that bins are made for: their number grows with its third power."""
    min_cell_share = 0.03
    """Share of a cell's pixels from which a colour occurs in it."""
    min_cells_share = 0.3
    """Share of a plane's cells from which a colour is the plane's own."""
    base_share = 0.3
    """A piece without edges that covers this share of the plane is the plane."""
    shade = (0.45, 1.6)
    """Ratios of brightness between which the same hue may be the plane in shadow or sun."""
    same_hue = 0.2
    """Largest difference of hue then, as a share of the contrast."""
    min_cells = 6
    """Fewest cells of a plane that tell its own colours."""


def find_outlier_colors(lab: np.ndarray, inside: np.ndarray, pieces: np.ndarray, contrast: float) -> np.ndarray:
    """Pixels of a plane whose colour occurs in few places of it.

    Args:
        lab: CIELAB, each channel 0 to 255, float32 [h, w, 3].
        inside: the plane, bool [h, w].
        pieces: int32 [h, w], number of the pixel's piece, between which colours change abruptly.
        contrast: difference of colours from which they are not alike.

    Returns:
        uint8 [h, w]: 0, or in what the colour differs from those that occur all over the plane, BRIGHTNESS (which may
        be a shadow's) or HUE.
    """
    rows, columns = np.nonzero(inside)
    t = OutlierColorTuning
    size = max(1, inside.shape[1] // t.cells)
    least = 0.2 * size * size
    if np.count_nonzero(np.bincount(rows // size * t.cells * 2 + columns // size) >= least) < t.min_cells:
        return np.zeros(inside.shape, np.uint8)
    width = max(contrast, t.min_contrast)
    return outlier_colors(
        lab, inside, pieces, light=_light(rows, columns, lab[rows, columns, 0]),
        bins=(t.brightness_bin * width, t.hue_bin * width, t.hue_bin * width), cell=size, least_cell=least,
        occurs=t.min_cell_share, usual=t.min_cells_share, base=t.base_share, same_hue=t.same_hue * contrast,
        shade=t.shade,
    )  # fmt: skip


def _light(rows: np.ndarray, columns: np.ndarray, brightness: np.ndarray) -> np.ndarray:
    """Brightness of the plane as a linear function of row, column and 1, float64 [3], which things of other brightness
    hardly move."""
    step = max(1, len(rows) // 1000)
    rows, columns, values = rows[::step], columns[::step], brightness[::step].astype(np.float64)
    some = np.stack([rows, columns, np.ones(len(rows))], 1)
    weight: np.ndarray = np.ones(len(some))
    fit: np.ndarray = np.zeros(3)
    for _ in range(3):
        weighted = some * weight[:, None]
        fit = np.linalg.solve(weighted.T @ some + 1e-6 * np.eye(3), weighted.T @ values)
        weight = 1 / (1 + np.abs(values - some @ fit) / 10) ** 2
    return fit
