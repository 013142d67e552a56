# SPDX-License-Identifier: Apache-2.0
"""Colours that a plane has at one place only. A wallpaper, a chequered floor or the grain of a table top is made of
many colours, all of which come again all over the plane; those of a picture or of a rug do not."""

from __future__ import annotations

import numpy as np

from ggslam.objects.pixel_passes import outlier_colors

BRIGHTNESS, HUE = 1, 2

_CELLS = 12
"""Cells of the image across, in which it is noted which colours occur."""
_BRIGHTNESS, _HUE = 1.0, 0.5
"""Width of bins of L and of a and b, as shares of the contrast."""
_LEAST_WIDTH = 8.0
"""Contrast that bins are at least made for: their number goes with its third power."""
_OCCURS = 0.03
"""Share of a cell's pixels from which a colour occurs in it."""
_USUAL = 0.3
"""Share of a plane's cells in which its own colours occur at least."""
_BASE = 0.3
"""A piece without edges that is so much of the plane is the plane."""
SHADE = (0.45, 1.6)
"""Ratios of brightness between which a colour of the same hue may be the plane in shadow or in the sun."""
_SAME_HUE = 0.2
"""Difference of hue of such colours at most, as a share of the contrast."""
_LEAST_CELLS = 6


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
    size = max(1, inside.shape[1] // _CELLS)
    least = 0.2 * size * size
    if np.count_nonzero(np.bincount(rows // size * _CELLS * 2 + columns // size) >= least) < _LEAST_CELLS:
        return np.zeros(inside.shape, np.uint8)
    width = max(contrast, _LEAST_WIDTH)
    return outlier_colors(
        lab, inside, pieces, light=_light(rows, columns, lab[rows, columns, 0]),
        bins=(_BRIGHTNESS * width, _HUE * width, _HUE * width), cell=size, least_cell=least, occurs=_OCCURS,
        usual=_USUAL, base=_BASE, same_hue=_SAME_HUE * contrast, shade=SHADE,
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
