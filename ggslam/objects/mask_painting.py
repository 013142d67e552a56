# SPDX-License-Identifier: Apache-2.0
"""From many overlapping masks to one image of segments."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np


def distinct_masks(masks: np.ndarray, scores: np.ndarray, overlap: float) -> np.ndarray:
    """Greedy non-maximum suppression: goes through masks by falling score, and drops those like one that is kept.

    Args:
        masks: bool [n, h, w].
        scores: float [n].
        overlap: two masks are alike if their intersection over union is above this.

    Returns:
        int64 [k], the masks kept, best first. Empty masks are dropped.
    """
    flat = masks.reshape(len(masks), math.prod(masks.shape[1:])).astype(np.float32)
    areas = flat.sum(1)
    shared = flat @ flat.T
    alike = shared > overlap * (areas[:, None] + areas[None, :] - shared)
    kept: list[int] = []
    for index in np.argsort(-scores, kind="stable"):
        if areas[index] > 0 and not alike[index, kept].any():
            kept.append(int(index))
    return np.array(kept, np.int64)


def paint_segments(masks: Sequence[np.ndarray], min_pixels: float) -> np.ndarray:
    """One image of all masks, the smaller ones on top.

    Args:
        masks: bool [H, W] each, at least one and at most 65535.
        min_pixels: masks of fewer pixels, in all or after others lie on top, are left out.

    Returns:
        uint16 [H, W], ids 1, 2, ... by falling area; 0 = under no mask.
    """
    areas = np.array([np.count_nonzero(mask) for mask in masks])
    segments = np.zeros(masks[0].shape, np.uint16)
    for number, index in enumerate(np.argsort(-areas, kind="stable"), 1):
        if areas[index] >= min_pixels:
            segments[masks[index]] = number
    visible = np.bincount(segments.ravel(), minlength=len(masks) + 1) >= max(min_pixels, 1)
    visible[0] = False
    return np.where(visible, np.cumsum(visible), 0).astype(np.uint16)[segments]
