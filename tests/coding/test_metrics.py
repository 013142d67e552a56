# SPDX-License-Identifier: Apache-2.0
"""Quality measures against values worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ggslam.coding.metrics import (
    CloudPair,
    color_quality,
    matching_rows,
    psnr,
    rgb_to_yuv,
)
from ggslam.geometry.normals import estimate_normals

PLANE = np.stack([*np.meshgrid(np.arange(20) * 10, np.arange(20) * 10), np.zeros((20, 20))], -1).reshape(-1, 3)
UP = np.tile([0.0, 0.0, 1.0], (len(PLANE), 1))


def test_psnr_of_known_errors() -> None:
    assert psnr(0, 1) == math.inf
    assert psnr(1, 100) == pytest.approx(20)
    assert psnr(4.5, 3 * 1023**2) == pytest.approx(58.436, abs=1e-3)  # a voxelised cloud at a quarter of 10 bits


@pytest.mark.parametrize("normals", [None, UP])
def test_a_plane_moved_along_its_normal_has_equal_d1_and_d2(normals: np.ndarray | None) -> None:
    quality = CloudPair(PLANE, PLANE + [0, 0, 3]).geometry(1023, normals)
    assert quality.d1_mse == pytest.approx(9) and quality.d2_mse == pytest.approx(9)
    assert quality.d1 == pytest.approx(10 * math.log10(3 * 1023**2 / 9)) == quality.d2


def test_a_plane_moved_within_itself_has_no_d2() -> None:
    quality = CloudPair(PLANE, PLANE + [2, -1, 0]).geometry(255)
    assert quality.d1_mse == pytest.approx(5) and quality.d2_mse == pytest.approx(0, abs=1e-20)
    assert quality.d1 == pytest.approx(10 * math.log10(3 * 255**2 / 5))


def test_equal_clouds_lose_nothing() -> None:
    pair = CloudPair(PLANE, PLANE[::-1])
    quality = pair.geometry(1023)
    assert quality.d1 == quality.d2 == math.inf
    colors = np.arange(3 * len(PLANE)).reshape(-1, 3) % 256
    assert set(pair.colors(colors, colors[::-1]).values().values()) == {math.inf}


def test_the_worse_direction_counts() -> None:
    whole, half = np.array([[0.0, 0, 0], [10, 0, 0]]), np.array([[0.0, 0, 0]])
    normals = np.array([[1.0, 0, 0], [0, 1, 0]])
    assert CloudPair(whole, half).geometry(1, normals).d1_mse == 50
    assert CloudPair(half, whole).geometry(1, normals[:1]).d1_mse == 50
    colors = np.array([[100, 100, 100], [100, 120, 100]])
    lost = CloudPair(whole, half).colors(colors, colors[:1])
    assert lost.g == pytest.approx(psnr(200, 255**2)) and lost.r == math.inf
    assert CloudPair(half, whole).colors(colors[:1], colors) == lost


def test_neighbours_at_one_distance_count_together() -> None:
    reference, decoded = np.array([[1.0, 0, 0]]), np.array([[0.0, 0, 0], [2, 0, 0]])
    quality = CloudPair(reference, decoded).colors(np.array([[100, 0, 0]]), np.array([[90, 0, 0], [110, 0, 0]]))
    assert quality.r == pytest.approx(psnr(100, 255**2))  # onwards the mean is right, backwards each is off by 10


def test_colours_row_by_row() -> None:
    reference = np.random.default_rng(0).integers(20, 230, (500, 3))
    grey = color_quality(reference, reference + 5)
    expected = 20 * math.log10(255 / 5)
    assert [grey.r, grey.g, grey.b, grey.y] == pytest.approx([expected] * 4)
    assert grey.u > 300 and grey.v > 300
    red = color_quality(reference, reference + [8, 0, 0])
    assert red.r == pytest.approx(20 * math.log10(255 / 8)) and red.g == red.b == math.inf
    assert red.y == pytest.approx(20 * math.log10(255 / (8 * 0.2126)))
    assert red.v == pytest.approx(20 * math.log10(255 / (8 * 0.5)))
    with pytest.raises(ValueError, match="two arrays"):
        color_quality(reference, reference[:-1])


def test_yuv_is_bt709() -> None:
    np.testing.assert_allclose(
        rgb_to_yuv(np.array([[255, 255, 255], [255, 0, 0], [0, 0, 255]])),
        [[255, 0, 0], [54.213, -29.2150, 127.5], [18.411, 127.5, -11.6910]], atol=1e-3,
    )  # fmt: skip


def test_rows_are_paired_by_position() -> None:
    generator = np.random.default_rng(1)
    points = generator.integers(0, 6, (300, 3)).astype(np.int32)  # many places hold several points
    order = generator.permutation(300)
    rows = matching_rows(points, points[order])
    assert rows is not None
    np.testing.assert_array_equal(points[order][rows], points)
    assert sorted(rows) == list(range(300))
    changed = points[order].copy()
    changed[7, 2] += 10
    assert matching_rows(points, changed) is None and matching_rows(points, points[1:]) is None


def test_normals_of_a_sphere_are_its_radii() -> None:
    points = np.random.default_rng(2).normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    normals = estimate_normals(5 * points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    assert np.abs((normals * points).sum(1)).mean() > 0.995
    assert np.isfinite(estimate_normals(points[:2])).all()
