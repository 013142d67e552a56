# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from ggslam.errors import ConfigError
from ggslam.native.loader import NativeContext, available_instruction_sets
from ggslam.volumes.quantization import key_centers, quantize


def reference(points: np.ndarray, resolution: float) -> tuple[np.ndarray, np.ndarray]:
    keys = np.floor(points.astype(np.float64) / resolution) + 32768
    return np.unique(keys.astype(np.uint16), axis=0, return_counts=True)


def in_order(keys: np.ndarray) -> np.ndarray:
    return np.lexsort(keys.T[::-1])


@pytest.mark.parametrize("name", available_instruction_sets())
@pytest.mark.parametrize("resolution", [0.25, 0.5, 4.0])  # exact, so that division and multiplication round alike
def test_distinct_voxels_and_their_counts(name: str, resolution: float) -> None:
    points = np.random.default_rng(1).normal(0, 3, (5000, 3)).astype(np.float32)
    found = quantize(points, resolution, NativeContext(2, name), count=True)
    keys, counts = reference(points, resolution)
    order = in_order(found.keys)
    np.testing.assert_array_equal(found.keys[order], keys)
    assert found.counts is not None
    np.testing.assert_array_equal(found.counts[order], counts)


def test_centres_lie_in_the_voxels_of_their_points() -> None:
    points = np.random.default_rng(2).uniform(-2, 2, (300, 3)).astype(np.float32)
    found = quantize(points, 0.07, NativeContext(1))
    distance = np.abs(points[:, None] - found.centers()[None]).max(-1).min(1)
    assert distance.max() <= 0.035 + 1e-6
    again = quantize(found.centers(), 0.07, NativeContext(1))
    np.testing.assert_array_equal(again.keys[in_order(again.keys)], found.keys[in_order(found.keys)])


def test_borders_belong_to_the_upper_voxel() -> None:
    found = quantize(np.array([[0, -0.5, 0.5]]), 0.5, NativeContext(1))
    np.testing.assert_array_equal(found.keys, [[32768, 32767, 32769]])
    np.testing.assert_array_equal(key_centers(found.keys, 0.5), [[0.25, -0.25, 0.75]])


def test_points_without_a_voxel_are_left_out() -> None:
    points = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, 1e9], [1e5, 0, 0], [0.1, 0.1, 0.1]])
    found = quantize(points, 0.5, NativeContext(1), count=True)
    np.testing.assert_array_equal(found.keys, [[32768, 32768, 32768]])
    np.testing.assert_array_equal(found.counts, [1])


def test_no_points() -> None:
    assert quantize(np.empty((0, 3)), 0.1, NativeContext(1)).keys.shape == (0, 3)


def test_refuses_what_it_cannot_use() -> None:
    with pytest.raises(ConfigError, match="resolution"):
        quantize(np.zeros((1, 3)), 0.0, NativeContext(1))
    with pytest.raises(ConfigError, match="resolution"):
        quantize(np.zeros((1, 3)), float("nan"), NativeContext(1))
    with pytest.raises(ValueError, match=r"\[N, 3\]"):
        quantize(np.zeros((4, 2)), 0.1, NativeContext(1))
