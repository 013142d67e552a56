# SPDX-License-Identifier: Apache-2.0
"""Codebooks: numbers, and rows of numbers, as indices into short tables, by k-means; the same every time."""

from __future__ import annotations

import heapq
import math
import warnings

import numpy as np
from scipy.cluster.vq import kmeans2, vq

from ggslam.system.tuning import Tuning


class CodebookTuning(Tuning):
    """How codebooks are learned."""

    scalar_steps = 300
    """Most rounds of k-means for a codebook of numbers."""
    coarse_steps = 6
    """Rounds of k-means for the coarse clusters of a palette."""
    fine_steps = 5
    """Rounds of k-means within a coarse cluster."""
    sample = 1 << 16
    """Rows that the coarse clusters are learned from."""


def scalar_codebook(values: np.ndarray, size: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """The least squared error of numbers as indices into a table (Lloyd-Max).

    Args:
        values: float, of any shape, finite, at least one.
        size: of the table.

    Returns:
        The table, float32 [size], rising, and indices of the shape of `values` (uint8 up to a size of 256).
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    middle = ordered[len(ordered) // 2]
    different = ordered[np.flatnonzero(np.diff(ordered, prepend=-np.inf))]
    exact = len(different) <= size
    centres = different if exact else middle + _lloyd(ordered - middle, size)
    table = np.full(size, centres[-1], np.float32)
    table[: len(centres)] = centres
    labels = np.searchsorted((table[1:].astype(np.float64) + table[:-1]) / 2, values)
    return table, labels.astype(np.uint8 if size <= 256 else np.uint32)


def _lloyd(ordered: np.ndarray, size: int) -> np.ndarray:
    """Means of cells of rising numbers: the cell of the largest error is cut at its mean until there are enough, then
    every cell takes what is nearest to its mean until nothing changes."""
    sums, squares = (np.concatenate([[0], np.cumsum(values)]) for values in (ordered, ordered**2))

    def cell(first: int, last: int) -> tuple[float, int, int]:
        if last - first == 1:
            return np.inf, first, last  # nothing to cut
        return (sums[last] - sums[first]) ** 2 / (last - first) - (squares[last] - squares[first]), first, last

    cells = [cell(0, len(ordered))]
    while len(cells) < size:
        _, first, last = heapq.heappop(cells)
        cut = first + int(np.searchsorted(ordered[first:last], (sums[last] - sums[first]) / (last - first), "right"))
        cut = min(max(cut, first + 1), last - 1)
        heapq.heappush(cells, cell(first, cut))
        heapq.heappush(cells, cell(cut, last))
    starts, centres = np.sort([first for _, first, _ in cells]), np.zeros(size)
    for _ in range(CodebookTuning.scalar_steps):
        ends = np.append(starts, len(ordered))
        counts = np.diff(ends)
        centres = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), centres)
        moved = np.append(0, np.searchsorted(ordered, (centres[1:] + centres[:-1]) / 2))
        if (moved == starts).all():
            break
        starts = moved
    return centres


def vector_palette(rows: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """A palette for rows, by k-means in two stages: coarse clusters, then entries of each by the error it has.

    Args:
        rows: float32 [N, D], finite.
        size: of the palette at most.

    Returns:
        The palette, float32 [size or less, D], and the entry of each row, int64 [N].
    """
    if len(rows) <= size:
        return rows, np.arange(len(rows))
    random = np.random.default_rng(0)
    sample = (
        rows
        if len(rows) <= CodebookTuning.sample
        else rows[np.sort(random.choice(len(rows), CodebookTuning.sample, replace=False))]
    )
    coarse = _kmeans(sample, math.isqrt(size), CodebookTuning.coarse_steps, random)
    cluster, distance = vq(rows, coarse, check_finite=False)
    members = np.split(np.argsort(cluster, kind="stable"), np.cumsum(np.bincount(cluster, minlength=len(coarse)))[:-1])
    errors = np.array([np.square(distance[index], dtype=np.float64).sum() for index in members])
    entries = 1 + np.floor((size - len(coarse)) * errors / max(errors.sum(), 1e-300)).astype(int)
    palette, labels, used = [], np.empty(len(rows), np.int64), 0
    for index, count in zip(members, entries.tolist(), strict=True):
        if not len(index):
            continue
        fine = _kmeans(rows[index], min(count, len(index)), CodebookTuning.fine_steps, random)
        labels[index] = used + vq(rows[index], fine, check_finite=False)[0]
        palette.append(fine)
        used += len(fine)
    return np.concatenate(palette), labels


def _kmeans(rows: np.ndarray, size: int, steps: int, random: np.random.Generator) -> np.ndarray:
    """Centres float32 [size, D] of rows, begun at some of them."""
    start = rows[np.sort(random.choice(len(rows), size, replace=False))]
    if size == len(rows):
        return start
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # equal rows leave centres without members
        return kmeans2(rows, start, iter=steps, minit="matrix", check_finite=False)[0].astype(np.float32)
