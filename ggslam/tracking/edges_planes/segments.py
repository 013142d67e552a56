# SPDX-License-Identifier: Apache-2.0
"""Segments of range images: neighbours belong together unless one of them hides what is between them and the other.

The criterion is the angle of I. Bogoslavskyi and C. Stachniss, "Fast Range Image-Based Segmentation of Sparse 3D Laser
Scans for Online Operation", IROS 2016; leaving out small segments before features are chosen follows LeGO-LOAM (T. Shan
and B. Englot, IROS 2018).
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np


class RangeSegments:
    """Segments of range images of one kind.

    Args:
        across: float [H, W - 1] or a number: angle between the rays of neighbours in a row, radians.
        down: float [H - 1, W] or a number: the same in a column.
        angle_deg: neighbours at ranges d1 >= d2, whose rays are alpha apart, are of one segment if the angle between
            the farther one's ray and the line through both, atan2(d2 sin(alpha), d1 - d2 cos(alpha)), is larger. It
            is large on a surface seen from the front, and small where one thing is before another.
    """

    def __init__(self, across: np.ndarray | float, down: np.ndarray | float, angle_deg: float) -> None:
        angles = [np.asarray(angle, float) for angle in (down, across)]
        self.trigonometry = [(np.sin(a).astype(np.float32), (1 - np.cos(a)).astype(np.float32)) for a in angles]
        """Sine and 1 - cosine of the angles, float32, in a column and in a row."""
        self.tangent = np.float32(math.tan(math.radians(angle_deg)))

    def labels(self, ranges: np.ndarray, noise: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Segments of a range image.

        Args:
            ranges: float32 [H, W], metres; 0 where nothing was measured.
            noise: float32 [H, W], how far the ranges of neighbours on one surface may be apart by noise alone, metres;
                None: none.

        Returns:
            Number of each pixel's segment, int32 [H, W], 0 where nothing was measured; pixels of each segment by
            number, [n], the first of them of what was not measured.
        """
        height, width = ranges.shape
        # Between any two neighbours lies a cell that joins them or not.
        cells = np.zeros((2 * height - 1, 2 * width - 1), np.uint8)
        cells[::2, ::2] = ranges > 0
        for axis, part in ((1, cells[::2, 1::2]), (0, cells[1::2, ::2])):
            one, other = (slice(None),) * axis + (slice(-1),), (slice(None),) * axis + (slice(1, None),)
            allowed = np.float32(0) if noise is None else np.maximum(noise[one], noise[other])
            part[:] = self._are_one(ranges[one], ranges[other], allowed, *self.trigonometry[axis])
        count, labels = cv2.connectedComponents(cells, connectivity=4, ltype=cv2.CV_32S)
        own = np.ascontiguousarray(labels[::2, ::2])
        return own, np.bincount(own.reshape(-1), minlength=count)

    def without_small(self, ranges: np.ndarray, least: int, noise: np.ndarray | None = None) -> np.ndarray:
        """Whether a pixel was measured and is of a segment of at least `least` pixels, bool [H, W]. Arguments as of
        `labels`."""
        labels, sizes = self.labels(ranges, noise)
        kept = sizes >= least
        kept[0] = False
        return kept[labels]

    def _are_one(
        self, one: np.ndarray, other: np.ndarray, allowed: Any, sine: np.ndarray, versine: np.ndarray
    ) -> np.ndarray:
        """Whether neighbours belong together, both measured and by `allowed` less far apart."""
        far, near = np.maximum(one, other), np.minimum(one, other)
        # tan(beta) without its division; 1 - cos(alpha), as the cosine of a fine camera is 1 in single precision
        apart = np.maximum(far - near - allowed, 0)
        return (near > 0) & (near * sine > self.tangent * (apart + near * versine))

