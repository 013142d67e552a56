# SPDX-License-Identifier: Apache-2.0
"""Making colour, depth and mask images smaller, each in the way its meaning allows."""

from __future__ import annotations

import math

import cv2
import numpy as np

DEPTH_TOLERANCE = np.float32(1.02)
"""Depths under a pixel that are within 2 % of the nearest one belong to the same surface."""


def resize_color(color: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average of a colour image uint8 [H, W, 3] on `height` x `width` pixels (bilinear when enlarged)."""
    if color.shape[:2] == (height, width):
        return color
    smaller = width <= color.shape[1] and height <= color.shape[0]
    return cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def resize_depth(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """Depth float32 [H, W] on `height` x `width` pixels, without inventing surfaces between foreground and background.

    Of the samples under a new pixel only those within 2 % of the nearest valid one are averaged; fewer than half of
    them valid gives 0. Enlarging takes the nearest pixel.
    """
    if depth.shape == (height, width):
        return depth
    far = np.float32(1e9)
    known = np.where(depth > 0, depth, far)
    samples = _samples_of(known, width, height)
    missing = np.zeros((height, width), np.int16)
    nearest = samples[0].copy()
    for z in samples:
        missing += z == far
        np.minimum(nearest, z, out=nearest)
    limit = nearest * DEPTH_TOLERANCE
    total, count = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    for z in samples:
        same = z < limit
        total += z * same
        count += same
    return np.where((2 * missing <= len(samples)) & (nearest < far), total / count, np.float32(0))


def resize_mask(mask: np.ndarray, width: int, height: int) -> np.ndarray:
    """Nearest pixel of an id image uint16 [H, W] on `height` x `width` pixels (ids are never mixed)."""
    if mask.shape == (height, width):
        return mask
    return mask[_nearest(mask.shape[0], height)][:, _nearest(mask.shape[1], width)]


def _samples_of(image: np.ndarray, width: int, height: int) -> list[np.ndarray]:
    """The samples of a float32 image under every new pixel, each [height, width], row by row."""
    rows = _samples(image.shape[0], height)
    step = image.shape[1] // width
    if image.shape[1] % width == 0 and step <= 4:  # neighbours as channels: OpenCV splits them several times quicker
        channels = cv2.split(np.ascontiguousarray(image).reshape(-1, width, step))
        return [channel[r] for r in rows for channel in channels]
    return [image[r][:, c] for r in rows for c in _samples(image.shape[1], width)]


def _samples(size: int, new_size: int) -> list[np.ndarray | slice]:
    """For each sample taken under a new pixel along one axis: source index of every new pixel, int64 [new_size] (or the
    slice that is the same, and quicker, when the sizes divide)."""
    if size % new_size == 0:
        return [slice(k, None, size // new_size) for k in range(size // new_size)]
    ratio = size / new_size
    count = max(1, math.ceil(ratio - 0.05))
    start = np.arange(new_size)
    return [np.minimum(((start + (k + 0.5) / count) * ratio).astype(np.int64), size - 1) for k in range(count)]


def _nearest(size: int, new_size: int) -> np.ndarray:
    """Source index nearest to the centre of every new pixel, int64 [new_size]; ties go to the lower index."""
    centres = np.ceil((np.arange(new_size) + 0.5) * (size / new_size) - 1.0 - 1e-9)
    return np.clip(centres, 0, size - 1).astype(np.int64)
