# SPDX-License-Identifier: Apache-2.0
"""Bringing depth to the pixels of a finer colour image (after J. Kopf et al., "Joint Bilateral Upsampling", 2007).

Within a surface inverse depth is interpolated, so that planes stay planes. Where samples around a pixel lie on several
surfaces, colour says which one it shows, and no other is mixed in: an edge may move, but nothing hangs between.
"""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.system.tuning import Tuning


class UpsamplingTuning(Tuning):
    """How depth is brought to finer pixels."""

    color_sigma = 18.0
    """Difference at which a sample's weight falls off, in grey values."""
    place_sigma = 0.8
    """Distance at which a sample's weight falls off, in samples."""
    reach = 1
    """Samples to each side."""
    same_surface = np.float32(1.05)
    """Neighbouring samples within this factor are of one surface: a floor seen flat falls by 2 % per sample."""


def upsample_depth(depth: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Depth of the same view on the pixels of a finer colour image.

    Args:
        depth: float32 [h, w] metres, 0 = none.
        color: uint8 [H, W, 3], H >= h and W >= w.

    Returns:
        float32 [H, W] metres; 0 where the nearest sample is none.
    """
    height, width = color.shape[:2]
    if depth.shape == (height, width):
        return depth
    inverse = np.zeros_like(depth)
    np.divide(np.float32(1), depth, out=inverse, where=depth > 0)
    columns, rows = _places(depth.shape[1], width), _places(depth.shape[0], height)
    nearest = np.ix_(np.rint(rows).astype(int), np.rint(columns).astype(int))
    fine = _bilinear(inverse, rows, columns)
    seen = inverse[nearest] > 0
    several = seen & _several_surfaces(inverse, rows, columns)
    if several.any():
        fine[several] = _choose(inverse, color, several, rows, columns)
    result = np.zeros((height, width), np.float32)
    np.divide(np.float32(1), fine, out=result, where=seen & (fine > 0))
    return result


def _places(size: int, new_size: int) -> np.ndarray:
    """Where the centre of every new pixel lies among the samples of one axis, float64 [new_size]."""
    return np.clip((np.arange(new_size) + 0.5) * size / new_size - 0.5, 0, size - 1)


def _bilinear(image: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """A float32 image between its samples, float32 [rows, columns]."""

    def between(values: np.ndarray, at: np.ndarray, axis: int) -> np.ndarray:
        low = np.minimum(np.floor(at).astype(int), values.shape[axis] - 2) if values.shape[axis] > 1 else at.astype(int)
        share = (at - low).astype(np.float32)
        share = share[:, None] if axis == 0 else share
        one, other = np.take(values, low, axis), np.take(values, np.minimum(low + 1, values.shape[axis] - 1), axis)
        return one + share * (other - one)

    return between(between(image, rows, 0), columns, 1)


def _several_surfaces(inverse: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Pixels around which samples lie on several surfaces, or are none; bool [rows, columns]."""
    kernel = np.ones((2, 2), np.uint8)
    # Of the cell between samples (i, j) and (i + 1, j + 1); what lies outside counts for nothing.
    most = cv2.dilate(inverse, kernel, anchor=(0, 0))
    least = cv2.erode(inverse, kernel, anchor=(0, 0))
    mixed = most > UpsamplingTuning.same_surface * least
    cells = [np.minimum(np.floor(at).astype(int), max(size - 2, 0)) for at, size in
             ((rows, inverse.shape[0]), (columns, inverse.shape[1]))]  # fmt: skip
    return np.asarray(mixed[np.ix_(*cells)])


def _choose(
    inverse: np.ndarray, color: np.ndarray, several: np.ndarray, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """Inverse depth of the pixels of `several`: of the surface that most of what is alike in place and colour is on."""
    height, width = inverse.shape
    v, u = np.nonzero(several)
    at_row, at_column = rows[v], columns[u]
    coarse = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    here = color[v, u].astype(np.float32)
    first_row, first_column = np.rint(at_row).astype(int), np.rint(at_column).astype(int)
    samples, weights = [], []
    for down in range(-UpsamplingTuning.reach, UpsamplingTuning.reach + 1):
        for right in range(-UpsamplingTuning.reach, UpsamplingTuning.reach + 1):
            row, column = first_row + down, first_column + right
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            row, column = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
            far = ((row - at_row) ** 2 + (column - at_column) ** 2) / (2 * UpsamplingTuning.place_sigma**2)
            unlike = ((coarse[row, column] - here) ** 2).mean(1) / (2 * UpsamplingTuning.color_sigma**2)
            value = inverse[row, column]
            samples.append(value)
            weights.append(np.where(inside & (value > 0), np.exp(-far - unlike), 0).astype(np.float32))
    return _strongest_surface(np.stack(samples), np.stack(weights))


def _strongest_surface(samples: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weighted mean of the samples [k, n] around the one that has most weight about it, float32 [n]."""
    best, support = samples[0], np.full(samples.shape[1], -1.0, np.float32)
    for sample, weight in zip(samples, weights, strict=True):
        near = (samples < sample * UpsamplingTuning.same_surface) & (samples * UpsamplingTuning.same_surface > sample)
        found = np.where(weight > 0, (near * weights).sum(0), -1).astype(np.float32)
        better = found > support
        best, support = np.where(better, sample, best), np.where(better, found, support)
    near = (samples < best * UpsamplingTuning.same_surface) & (samples * UpsamplingTuning.same_surface > best)
    total = (near * weights).sum(0)
    return np.asarray(np.where(total > 0, (near * weights * samples).sum(0) / np.maximum(total, 1e-30), best))
