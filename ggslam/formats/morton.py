# SPDX-License-Identifier: Apache-2.0
"""An order of points in which neighbours in the file are neighbours in space."""

from __future__ import annotations

import numpy as np


def morton_order(points: np.ndarray) -> np.ndarray:
    """Indices int64 [N] that put points, float [N, 3], in the order of a Z-shaped curve of 2^16 cells a side."""
    low = points.min(0)
    extent = max(float((points.max(0) - low).max()), 1e-12)
    cells = ((points - low) / extent * 65535).astype(np.uint64)
    key = np.zeros(len(points), np.uint64)
    for axis in range(3):
        key |= _spread(cells[:, axis]) << np.uint64(axis)
    return np.argsort(key, kind="stable")


def _spread(values: np.ndarray) -> np.ndarray:
    """Puts two zero bits between the 16 bits of numbers (uint64)."""
    steps = ((16, 0x00FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249))
    for shift, mask in steps:
        values = (values | (values << np.uint64(shift))) & np.uint64(mask)
    return values
