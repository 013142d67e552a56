# SPDX-License-Identifier: Apache-2.0
"""Convex outlines on a plane."""

from __future__ import annotations

import cv2
import numpy as np


def convex_outline(places: np.ndarray) -> np.ndarray:
    """The corners [n, 2] of the convex hull of places [m, 2], one after the other."""
    middle = places.mean(0)  # OpenCV computes in single precision
    return np.asarray(cv2.convexHull((places - middle).astype(np.float32))[:, 0] + middle)


def outline_gap(outline: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Metres [m] from places [m, 2] to an outline [n, 2]; 0 inside."""
    begin, edge = outline, np.roll(outline, -1, 0) - outline
    nearest, left, right = np.full(len(places), np.inf), np.ones(len(places), bool), np.ones(len(places), bool)
    for start, way in zip(begin, edge, strict=True):
        rest = places - start
        along = np.clip(rest @ way / max(float(way @ way), 1e-18), 0, 1)
        nearest = np.minimum(nearest, np.hypot(*(rest - along[:, None] * way).T))
        side = way[0] * rest[:, 1] - way[1] * rest[:, 0]
        left &= side >= 0
        right &= side <= 0
    return np.where((left | right) & (len(outline) > 2), 0.0, nearest)
