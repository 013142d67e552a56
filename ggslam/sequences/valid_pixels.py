# SPDX-License-Identifier: Apache-2.0
"""Pixels of a recording that show nothing: beyond the border of an image whose lens distortion was undone, here or by
whoever stored it."""

from __future__ import annotations

import cv2
import numpy as np

ALIKE = 3
"""Grey values by which pixels of one fill may differ, after compression too."""
LEAST_SHARE = 0.002
"""Of the image, below which a fill is none."""
LEAST_OVERLAP = 0.98
"""Intersection over union of a fill in two images: what is filled stays where it is, what a camera sees does not."""
LEAST_CHANGE = 3.0
"""Mean grey values by which two images have to differ beside the fill, to say that the camera moved."""


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
        cv2.floodFill(image, found, corner, 0, (ALIKE,) * 3, (ALIKE,) * 3, flags)
    fill = found[1:-1, 1:-1] > 0
    return fill if fill.mean() >= LEAST_SHARE else None


def common_fill(first: np.ndarray, fill: np.ndarray, others: list[np.ndarray]) -> np.ndarray | None:
    """The fill that an image shares with others of the recording, bool [H, W]; None if it is none, or cannot be told.

    Args:
        first: uint8 [H, W, 3], with what `fill_of` says of it.
        others: of the same size, from other places of the recording.
    """
    common, moved = fill, False
    for other in others:
        same = fill_of(other) if other.shape == first.shape else None
        if same is None or (same & fill).sum() < LEAST_OVERLAP * (same | fill).sum():
            return None
        difference = np.abs(other.astype(np.int16) - first).mean(2)
        if difference[same].max(initial=0) > 2 * ALIKE:
            return None
        moved = moved or bool(difference[~same].mean() > LEAST_CHANGE) if not same.all() else moved
        common = common | same
    return common if moved else None
