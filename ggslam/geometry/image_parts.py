# SPDX-License-Identifier: Apache-2.0
"""Parts of images: connected ones, coarse grids, and points that fall on them."""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.scene.camera import Camera


def parts_with_seeds(seeds: np.ndarray, candidates: np.ndarray, least_share: float) -> np.ndarray:
    """The connected parts of `candidates`, bool [h, w], of which at least a share are `seeds`, which are candidates."""
    count, labels = cv2.connectedComponents(candidates.astype(np.uint8), connectivity=8)
    inside, of_them = (np.bincount(labels[image], minlength=count) for image in (candidates, seeds & candidates))
    good = (inside > 0) & (of_them >= least_share * np.maximum(inside, 1)) & (of_them > 0)
    return candidates & good[labels]


def coarse_grid(shape: tuple[int, ...], stride: int) -> np.ndarray:
    """The pixels in the middle of each square of `stride` rows and columns, bool [H, W] of `shape`."""
    grid = np.zeros(shape, bool)
    grid[stride // 2 :: stride, stride // 2 :: stride] = True
    return grid


def is_in_image_part(points: np.ndarray, part: np.ndarray, camera: Camera) -> np.ndarray:
    """Which points [n, 3] in the camera's frame fall on a part of its image, bool [H, W]; bool [n]."""
    rows, columns, inside = camera.project(points)
    return inside & part[rows, columns]
