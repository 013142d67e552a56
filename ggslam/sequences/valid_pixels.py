# SPDX-License-Identifier: Apache-2.0
"""Pixels of a recording that show nothing: beyond the border of an image whose lens distortion was undone, here or by
whoever stored it."""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.system.tuning import Tuning


class FillTuning(Tuning):
    """When pixels of one colour are fill and no image."""

    alike = 3
    """Largest difference of pixels of one fill, in grey values, also after compression."""
    min_share = 0.002
    """Smallest fill, as a share of the image."""
    min_overlap = 0.98
    """Smallest intersection over union of a fill in two images: fill stays where it is."""
    min_change = 3.0
    """Mean difference of two images beside the fill once the camera has moved, in grey values."""


def within_source(columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Pixels whose source, float32 [H, W] columns and rows of an image as large, lies inside it; bool [H, W]."""
    height, width = columns.shape
    inside = (columns >= 0) & (columns <= width - 1) & (rows >= 0) & (rows <= height - 1)
    return np.asarray(inside)


def fill_of(color: np.ndarray) -> np.ndarray | None:
    """What is of one colour from a corner on, bool [H, W] of an image uint8 [H, W, 3]; None if it is too little."""
    height, width = color.shape[:2]
    found = np.zeros((height + 2, width + 2), np.uint8)
    flags = 4 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | 1 << 8
    image = np.array(color, order="C")  # OpenCV takes no read-only array here, though with this flag it writes nothing
    for corner in ((0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)):
        cv2.floodFill(image, found, corner, 0, (FillTuning.alike,) * 3, (FillTuning.alike,) * 3, flags)
    fill = found[1:-1, 1:-1] > 0
    return fill if fill.mean() >= FillTuning.min_share else None


def common_fill(first: np.ndarray, fill: np.ndarray, others: list[np.ndarray]) -> np.ndarray | None:
    """The fill that an image shares with others of the recording, bool [H, W]; None if it is none, or cannot be told.

    Args:
        first: uint8 [H, W, 3], with what `fill_of` says of it.
        others: of the same size, from other places of the recording.
    """
    common, moved = fill, False
    for other in others:
        same = fill_of(other) if other.shape == first.shape else None
        if same is None or (same & fill).sum() < FillTuning.min_overlap * (same | fill).sum():
            return None
        difference = np.abs(other.astype(np.int16) - first).mean(2)
        if difference[same].max(initial=0) > 2 * FillTuning.alike:
            return None
        moved = moved or bool(difference[~same].mean() > FillTuning.min_change) if not same.all() else moved
        common = common | same
    return common if moved else None
