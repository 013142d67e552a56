# SPDX-License-Identifier: Apache-2.0
"""The compiled grid against the equation p~ = clip(floor(s p + 1/2 + rounding) - o, 0, size - 1)."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.coding.quantization import Quantization, QuantizationTuning

ORIGIN, SIZE = (-5, 0, 2), (40, 100, 70)


def expected(points: np.ndarray, scale: float) -> np.ndarray:
    exact = scale == 1 and np.issubdtype(points.dtype, np.integer)
    whole = (
        points.astype(np.int64)
        if exact
        else np.floor(points.astype(np.float64) * scale + 0.5 + QuantizationTuning.rounding)
    )
    return np.clip(whole - ORIGIN, 0, np.array(SIZE) - 1).astype(np.int32)


@pytest.mark.parametrize("kind", [np.int16, np.int32, np.int64, np.float32, np.float64])
@pytest.mark.parametrize("scale", [1.0, 0.37])
def test_positions_of_any_type(kind: type, scale: float) -> None:
    points = np.random.default_rng(1).uniform(-30, 150, (5000, 3)).astype(kind)
    grid = Quantization(scale, ORIGIN, SIZE).of(points)
    want = expected(points, scale)
    rows = np.random.default_rng(2).integers(0, len(points), 700)
    assert np.array_equal(grid.positions(), want)
    assert np.array_equal(grid.positions(rows), want[rows])
    for axis in range(3):
        assert np.array_equal(grid.coordinates(axis, rows), want[rows, axis])
        assert np.array_equal(grid.plane_counts(axis), np.bincount(want[:, axis], minlength=SIZE[axis]))


def test_64_bit_integers_keep_their_last_digit() -> None:
    far = (1 << 53) + 1
    grid = Quantization(1.0, (far, far, far), (10, 10, 10)).of(np.full((2, 3), far + 3, np.int64))
    assert grid.positions().tolist() == [[3, 3, 3]] * 2


def test_planes_are_numbered_and_the_cut_ones_listed() -> None:
    points = np.random.default_rng(3).integers(0, 100, (4000, 3))
    grid, rows = Quantization(1.0, (0, 0, 0), (100, 100, 100)).of(points), np.arange(0, 4000, 3)
    table, cut = np.arange(100) // 7, np.isin(np.arange(100), [3, 50])
    numbers, inside = grid.number_planes(1, table, grid.plane_counts(1, rows), cut, rows)
    assert np.array_equal(numbers, table[points[rows, 1]])
    assert np.array_equal(inside, np.flatnonzero(cut[points[rows, 1]]))


def test_points_that_are_not_contiguous() -> None:
    points = np.random.default_rng(4).uniform(0, 60, (300, 6))[::2, ::2]
    assert np.array_equal(Quantization(1.0, ORIGIN, SIZE).of(points).positions(), expected(points, 1.0))


def test_other_rows_are_refused() -> None:
    with pytest.raises(ValueError, match="int64 rows"):
        Quantization(1.0, ORIGIN, SIZE).of(np.zeros((4, 3))).positions(np.arange(2, dtype=np.int32))
