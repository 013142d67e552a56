# SPDX-License-Identifier: Apache-2.0
"""Making colour, depth and mask images smaller, each in the way its meaning allows."""

from __future__ import annotations

import math

import cv2
import numpy as np

from ggslam.system.tuning import Tuning


class ResamplingTuning(Tuning):
    """How depth is brought to another pixel grid."""

    min_weight = np.float32(0.1)
    """Smallest share of a usual sample's cover that tells which surface a pixel shows."""
    same_surface = np.float32(1.02)
    """Depths under a pixel up to this factor of the nearest one belong to one surface."""


def resize_color(color: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average of a colour image uint8 [H, W, 3] on `height` x `width` pixels (bilinear when enlarged)."""
    if color.shape[:2] == (height, width):
        return color
    smaller = width <= color.shape[1] and height <= color.shape[0]
    return cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def resize_depth(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """Depth float32 [H, W] on `height` x `width` pixels, without inventing surfaces between foreground and background.

    Of the samples under a new pixel only those within 2 % of the nearest valid one are averaged; fewer than half of
    them valid gives 0. Where sizes do not divide, samples count by how much of them lies under the new pixel, and
    inverse depths are averaged, so that a plane keeps its depth at the centre of every pixel. Enlarging takes the
    nearest pixel.
    """
    if depth.shape == (height, width):
        return depth
    if width < depth.shape[1] and height < depth.shape[0] and (depth.shape[1] % width or depth.shape[0] % height):
        return _resize_depth_by_area(depth, width, height)
    far = np.float32(1e9)
    known = np.where(depth > 0, depth, far)
    samples = _samples_of(known, width, height)
    missing = np.zeros((height, width), np.int16)
    nearest = samples[0].copy()
    for z in samples:
        missing += z == far
        np.minimum(nearest, z, out=nearest)
    limit = nearest * ResamplingTuning.same_surface
    total, count = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    for z in samples:
        same = z < limit
        total += z * same
        count += same
    return np.where((2 * missing <= len(samples)) & (nearest < far), total / count, np.float32(0))


def _resize_depth_by_area(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """Depth [H, W] on fewer pixels, whatever the factor; see `resize_depth`."""
    inverse = np.zeros_like(depth)
    np.divide(np.float32(1), depth, out=inverse, where=depth > 0)
    rows, columns = _overlaps(depth.shape[0], height), _overlaps(depth.shape[1], width)
    strips = [(np.take(inverse, index, axis=0), weight) for index, weight in rows]
    samples = [
        (np.take(strip, index, axis=1), row_weight[:, None] * weight[None, :])
        for strip, row_weight in strips
        for index, weight in columns
    ]
    nearest = np.zeros((height, width), np.float32)
    for inverse_z, weight in samples:  # what no more than touches a pixel does not decide which surface it shows
        np.maximum(
            nearest, inverse_z, out=nearest, where=weight * np.float32(len(samples)) > ResamplingTuning.min_weight
        )
    limit, most = nearest / ResamplingTuning.same_surface, nearest * ResamplingTuning.same_surface
    total, same, known = (np.zeros((height, width), np.float32) for _ in range(3))
    for inverse_z, weight in samples:
        near = weight * ((inverse_z > limit) & (inverse_z < most))
        total += near * inverse_z
        same += near
        known += weight * (inverse_z > 0)
    there = (known >= np.float32(0.5)) & (nearest > 0) & (total > 0)
    result = np.zeros((height, width), np.float32)
    np.divide(same, total, out=result, where=there)
    return result


def _overlaps(size: int, new_size: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """What lies under every new pixel along one axis, sample by sample: source index int64 [new_size] and weight
    float32 [new_size]. Weights of a new pixel add up to 1, and their mean place is its centre."""
    ratio = size / new_size
    begin, end = np.arange(new_size) * ratio, np.arange(1, new_size + 1) * ratio
    first = np.floor(begin + 1e-9).astype(np.int64)
    count = int((np.ceil(end - 1e-9).astype(np.int64) - first).max())
    at = first[:, None] + np.arange(count)
    weights = np.clip(np.minimum(end[:, None], at + 1) - np.maximum(begin[:, None], at), 0, None) / ratio
    offset = at + 0.5 - (begin + end)[:, None] / 2
    spread = (weights * offset**2).sum(1) - (weights * offset).sum(1) ** 2
    mean = (weights * offset).sum(1)
    tilt = np.divide(mean, spread, out=np.zeros(new_size), where=spread > 1e-9)
    weights = weights * (1 - tilt[:, None] * (offset - mean[:, None]))
    return [(np.minimum(at[:, k], size - 1), weights[:, k].astype(np.float32)) for k in range(count)]


def resize_mask(mask: np.ndarray, width: int, height: int, shared: bool = True) -> np.ndarray:
    """Ids uint16 [H, W] on `height` x `width` pixels, none of them mixed.

    A new pixel gets the id of the pixel at its centre; where the centre lies between pixels, the one that most of them
    have. Where several have as many, it is the first or the last of these by turns, as squares of a chessboard are:
    always the first would move all outlines by half a pixel against the colours. Without `shared` it is 0, none.
    """
    if mask.shape == (height, width):
        return mask
    rows, columns = _nearest(mask.shape[0], height), _nearest(mask.shape[1], width)
    first, *others = [mask[r][:, c] for r in rows for c in columns]
    if others:
        row, column = np.nonzero(np.any([other != first for other in others], axis=0))
        ids = np.stack([sample[row, column] for sample in (first, *others)])
        first[row, column] = _most_frequent(ids, (row + column) % 2 > 0, shared)
    return first


def _most_frequent(ids: np.ndarray, last: np.ndarray, shared: bool) -> np.ndarray:
    """Of each column of ids [S, n] the most frequent one; of several the first, or the last where `last`, bool [n]; 0
    without `shared`."""
    count = (ids[:, None] == ids).sum(1)
    begin, end = count.argmax(0), len(ids) - 1 - count[::-1].argmax(0)
    earliest, latest = (np.take_along_axis(ids, at[None], 0)[0] for at in (begin, end))
    found = np.where(last, latest, earliest)
    return found if shared else np.where(earliest == latest, found, 0)


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


def _nearest(size: int, new_size: int) -> list[np.ndarray]:
    """Source indices nearest to the centre of every new pixel, int64 [new_size]: one of each, or two where all centres
    lie between pixels; of other ties the lower index."""
    centres = (np.arange(new_size) + 0.5) * (size / new_size) - 0.5
    below = np.clip(np.ceil(centres - 0.5 - 1e-9), 0, size - 1).astype(np.int64)
    return [below, below + 1] if size % (2 * new_size) == 0 else [below]
