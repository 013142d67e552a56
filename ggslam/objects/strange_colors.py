# SPDX-License-Identifier: Apache-2.0
"""Colours that a plane has at one place only. A wallpaper, a chequered floor or the grain of a table top is made of
many colours, all of which come again all over the plane; those of a picture or of a rug do not."""

from __future__ import annotations

import numpy as np

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


def find_strange_colors(lab: np.ndarray, inside: np.ndarray, pieces: np.ndarray, contrast: float) -> np.ndarray:
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
    out = np.zeros(inside.shape, np.uint8)
    rows, columns = np.nonzero(inside)
    size = max(1, inside.shape[1] // _CELLS)
    cell = rows // size * _CELLS * 2 + columns // size
    cell, _, pixels = _number(cell)
    counted = pixels >= 0.2 * size * size
    if counted.sum() < _LEAST_CELLS:
        return out
    colors = lab[rows, columns].copy()
    colors[:, 0] -= _light(rows, columns, colors[:, 0])
    width = max(contrast, _LEAST_WIDTH) * np.array([_BRIGHTNESS, _HUE, _HUE], np.float32)
    bins = np.floor(colors / width).astype(np.int32)
    bins -= bins.min(0)
    sides = bins.max(0) + 1
    which, code, _ = _number((bins[:, 0] * sides[1] + bins[:, 1]) * sides[2] + bins[:, 2])
    place = np.stack(np.unravel_index(code, sides), 1)
    table = np.bincount(which * len(pixels) + cell, minlength=len(code) * len(pixels)).reshape(len(code), -1)
    # Bins that touch are alike: a colour is not at another place for being on the other side of a bin's edge.
    near = np.ones((len(code), len(code)), bool)
    for axis in place.T.astype(np.int16):
        near &= np.abs(axis[:, None] - axis[None]) <= 1
    share = (near.astype(np.float32) @ table.astype(np.float32)) / pixels
    usual = (share[:, counted] >= _OCCURS).mean(1) >= _USUAL
    mean = np.stack([np.bincount(which, lab[rows, columns, k]) / np.bincount(which) for k in range(3)], 1)
    shade = mean[:, None, 0] / np.maximum(mean[None, usual, 0], 1)
    hue = np.hypot(*(mean[:, None, k] - mean[None, usual, k] for k in (1, 2)))
    shaded = (hue < _SAME_HUE * contrast) & (shade > SHADE[0]) & (shade < SHADE[1])
    telling = ~usual & ~shaded.any(1)
    number = pieces[rows, columns]
    base = np.bincount(number) >= _BASE * len(rows)
    out[rows, columns] = np.where(base[number], 0, np.where(telling[which], HUE, np.where(usual[which], 0, BRIGHTNESS)))
    return out


def _number(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Small whole numbers [n] numbered through: each one's number [n], the values in order, how often each occurs."""
    count = np.bincount(values)
    there = np.flatnonzero(count)
    number = np.zeros(len(count), np.int32)
    number[there] = np.arange(len(there))
    return number[values], there, count[there]


def _light(rows: np.ndarray, columns: np.ndarray, brightness: np.ndarray) -> np.ndarray:
    """Brightness of the plane by a linear fit, which things of other brightness hardly move."""
    step = max(1, len(rows) // 1000)
    A = np.stack([rows, columns, np.ones(len(rows))], 1).astype(np.float64)
    some, values = A[::step], brightness[::step].astype(np.float64)
    weight: np.ndarray = np.ones(len(some))
    fit: np.ndarray = np.zeros(3)
    for _ in range(3):
        weighted = some * weight[:, None]
        fit = np.linalg.solve(weighted.T @ some + 1e-6 * np.eye(3), weighted.T @ values)
        weight = 1 / (1 + np.abs(values - some @ fit) / 10) ** 2
    return (A @ fit).astype(np.float32)
