# SPDX-License-Identifier: Apache-2.0
"""Codebooks: as good as they can be where that is known, the same every time, exact where there is room."""

from __future__ import annotations

import numpy as np
from sklearn.cluster import KMeans

from ggslam.formats.codebooks import scalar_codebook, vector_palette


def test_numbers_that_have_room_are_exact() -> None:
    values = np.array([[3.0, -1.5], [3.0, 0.25]], np.float32)
    table, labels = scalar_codebook(values)
    assert table.shape == (256,) and labels.dtype == np.uint8 and (np.diff(table) >= 0).all()
    np.testing.assert_array_equal(table[labels], values)


def test_errors_are_those_of_the_best_quantiser() -> None:
    """Known: of uniform numbers 1 / (12 size^2), of normal ones 0.009497 for 16 entries (Max 1960)."""
    random = np.random.default_rng(1)
    uniform, normal = random.random(20_000).astype(np.float32), random.normal(size=200_000).astype(np.float32)
    table, labels = scalar_codebook(uniform, 64)
    assert np.square(table[labels] - uniform).mean() < 1.02 / (12 * 64**2)
    table, labels = scalar_codebook(normal, 16)
    assert abs(np.square(table[labels] - normal).mean() / 0.009497 - 1) < 0.02
    nearest = np.abs(normal[:1000, None] - table[None, :16]).argmin(1)
    np.testing.assert_array_equal(labels[:1000], nearest)


def test_numbers_far_apart() -> None:
    """A few outliers do not take the entries of the rest."""
    values = np.concatenate([np.linspace(0, 1, 5000), [1e4, -1e4]]).astype(np.float32)
    table, labels = scalar_codebook(values)
    assert np.abs(table[labels] - values)[:5000].max() < 0.003


def test_a_palette_is_nearly_as_good_as_k_means() -> None:
    random = np.random.default_rng(2)
    strengths = np.exp(-np.arange(9) / 3)  # some directions matter more than others, as in spherical harmonics
    rows = (random.laplace(size=(6000, 9)) * strengths).astype(np.float32)
    palette, labels = vector_palette(rows, 400)
    assert palette.shape[1] == 9 and 380 < len(palette) <= 400 and labels.min() >= 0 and labels.max() < len(palette)
    reference = KMeans(400, n_init=1, max_iter=20, random_state=0).fit(rows)
    assert np.square(palette[labels] - rows).sum() < 1.2 * reference.inertia_
    again = vector_palette(rows, 400)
    np.testing.assert_array_equal(palette, again[0])
    np.testing.assert_array_equal(labels, again[1])


def test_rows_that_have_room_are_exact() -> None:
    rows = np.random.default_rng(3).normal(size=(50, 9)).astype(np.float32)
    palette, labels = vector_palette(rows, 64)
    np.testing.assert_array_equal(palette[labels], rows)
    same = np.zeros((3000, 9), np.float32)
    palette, labels = vector_palette(same, 64)
    assert not palette[labels].any() and len(palette) <= 64
