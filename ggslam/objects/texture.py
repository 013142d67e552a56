# SPDX-License-Identifier: Apache-2.0
"""Filling a gap in a picture with texture like that around it.

Criminisi, Perez, Toyama: "Region Filling and Object Removal by Exemplar-Based Image Inpainting", 2004: patch by patch
from the rim inwards, lines first, each patch the known one that fits best. The light, which changes slowly over a
surface, is then taken from a smooth interpolation (Telea 2004): a copied patch shall not bring that of its old place.
"""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.system.tuning import Tuning


class GapTextureTuning(Tuning):
    """How a gap is filled with texture."""

    half_patch = 4
    """Pixels of a patch on each side of its centre."""
    trend_weight = 0.05
    """Weight of agreement with the smooth interpolation, against agreement with the surroundings."""
    max_light = 0.1
    """Largest correction of brightness, in [0, 1]."""
    max_patches = 400
    """Patches that a gap may need, about; a larger gap is filled in a smaller picture."""


def fill_gap(picture: np.ndarray, known: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Colours in the gap, float32 [M, 3] in its row-major order.

    Args:
        picture: float32 [H, W, 3] in [0, 1].
        known: bool [H, W], where the picture may be copied from; at least one pixel.
        gap: bool [H, W], where colours are wanted.
    """
    size = 2 * GapTextureTuning.half_patch + 1
    most = GapTextureTuning.max_patches * size * size / 3
    if gap.sum() > most:
        return _filled_coarsely(picture, known, gap, float(np.sqrt(gap.sum() / most)))
    pixels = (255 * picture.clip(0, 1) + 0.5).astype(np.uint8)
    smooth = cv2.inpaint(pixels, (~known).astype(np.uint8), 5, cv2.INPAINT_TELEA).astype(np.float32) / 255
    textured = _copy_patches(picture.astype(np.float32), known & ~gap, gap, smooth)
    if textured is None:
        return smooth[gap]
    limit = GapTextureTuning.max_light
    light = cv2.GaussianBlur(smooth.mean(2) - textured.mean(2), (0, 0), size).clip(-limit, limit)
    return (textured + light[..., None])[gap].clip(0, 1)


def _filled_coarsely(picture: np.ndarray, known: np.ndarray, gap: np.ndarray, factor: float) -> np.ndarray:
    """`fill_gap` in a picture smaller by `factor`."""
    rows, columns = gap.shape
    size = max(1, int(columns / factor)), max(1, int(rows / factor))
    small_gap = cv2.resize(gap.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    small_known = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
    small = cv2.resize(np.where(known[..., None], picture, 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    if not small_known.any():
        small, small_known = cv2.resize(picture.astype(np.float32), size), ~small_gap
    small[small_gap] = fill_gap(small, small_known, small_gap)
    return np.asarray(cv2.resize(small, (columns, rows), interpolation=cv2.INTER_LINEAR))[gap]


def _copy_patches(picture: np.ndarray, known: np.ndarray, gap: np.ndarray, smooth: np.ndarray) -> np.ndarray | None:
    """The picture with the gap filled by known patches; what is neither known nor gap is `smooth`. None if no whole
    patch is known."""
    half = GapTextureTuning.half_patch
    size = 2 * half + 1
    whole = cv2.erode(known.astype(np.uint8), np.ones((size, size), np.uint8), borderValue=0) > 0
    if not whole.any():
        return None
    border = ((half, half), (half, half), (0, 0))
    canvas = np.pad(np.where(known[..., None], picture, smooth), border, mode="symmetric")
    trend = np.pad(smooth, border, mode="symmetric")
    done = np.pad(known, half)
    todo = np.pad(gap, half)
    confidence = done.astype(np.float32)
    candidates = whole[half:-half, half:-half]  # by the upper left corner of the patch in the picture
    while todo.any():
        row, column = _next_place(canvas, done, todo, confidence)
        window = slice(row - half, row + half + 1), slice(column - half, column + half + 1)
        mask = np.repeat(done[window].astype(np.float32)[..., None], 3, 2)
        fit = cv2.matchTemplate(picture, canvas[window], cv2.TM_SQDIFF, mask=mask)
        drift = cv2.matchTemplate(picture, trend[window], cv2.TM_SQDIFF, mask=1 - mask)
        cost = np.asarray(fit) + GapTextureTuning.trend_weight * np.asarray(drift)
        y, x = np.unravel_index(np.where(candidates, cost, np.inf).argmin(), cost.shape)
        fresh = todo[window]
        canvas[window][fresh] = picture[y : y + size, x : x + size][fresh]
        confidence[window][fresh] = confidence[window].mean()
        done[window] |= fresh
        todo[window] = False
    return canvas[half:-half, half:-half]


def _next_place(canvas: np.ndarray, done: np.ndarray, todo: np.ndarray, confidence: np.ndarray) -> tuple[int, int]:
    """Row and column of the gap's rim pixel to continue at: much is known around it, and a line runs into it."""
    rim = todo & (cv2.dilate(done.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    if not rim.any():  # nothing known touches what is left
        rim = todo
    size = 2 * GapTextureTuning.half_patch + 1
    sure = cv2.blur(confidence, (size, size))
    grey = np.where(done, canvas.mean(2), 0).astype(np.float32)
    solid = cv2.erode(done.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    edges = np.where(solid, np.abs(cv2.Sobel(grey, -1, 1, 0)) + np.abs(cv2.Sobel(grey, -1, 0, 1)), 0)
    lines = cv2.dilate(edges.astype(np.float32), np.ones((size, size), np.uint8))
    row, column = np.unravel_index(np.where(rim, sure * (0.1 + lines), -1).argmax(), rim.shape)
    return int(row), int(column)
