# SPDX-License-Identifier: Apache-2.0
"""Making images smaller."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.sequences.resampling import resize_color, resize_depth, resize_mask


def halved_depth(z: np.ndarray) -> np.ndarray:
    """The rule for factor 0.5, said plainly: 2 of 4 must be valid; the mean of those within 2 % of the nearest."""
    out = np.zeros((z.shape[0] // 2, z.shape[1] // 2), np.float32)
    for i, j in np.ndindex(out.shape):
        block = z[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
        valid = block[block > 0]
        if len(valid) >= 2:
            out[i, j] = valid[valid < valid.min() * np.float32(1.02)].mean()
    return out


def test_depth_halved_by_the_rule() -> None:
    rng = np.random.default_rng(0)
    z = rng.choice(np.array([0, 1.0, 1.015, 1.03, 2.0], np.float32), (40, 60))
    np.testing.assert_allclose(resize_depth(z, 30, 20), halved_depth(z), rtol=1e-6)


def test_depth_never_lies_between_surfaces() -> None:
    z = np.full((30, 45), 1.0, np.float32)
    z[:, 20:] = 3.0
    for size in ((15, 10), (30, 20), (31, 17), (7, 5)):
        assert set(np.unique(resize_depth(z, *size))) <= {np.float32(1.0), np.float32(3.0)}


@pytest.mark.parametrize("size", [(15, 10), (9, 6), (30, 20), (44, 29), (45, 30), (90, 60)])
def test_depth_of_a_slope_stays_on_it(size: tuple[int, int]) -> None:
    columns = np.arange(45, dtype=np.float32)
    z = np.tile(2 + 0.001 * columns, (30, 1))
    small = resize_depth(z, *size)
    centres = (np.arange(size[0]) + 0.5) * 45 / size[0] - 0.5
    assert np.abs(small - (2 + 0.001 * centres)).max() < 0.0011


def test_depth_without_values_stays_empty() -> None:
    assert not resize_depth(np.zeros((20, 30), np.float32), 15, 10).any()


def test_colour_is_an_area_mean() -> None:
    color = np.zeros((4, 4, 3), np.uint8)
    color[:2, :2] = [[[0, 0, 0], [100, 0, 0]], [[0, 40, 0], [0, 0, 200]]]
    assert resize_color(color, 2, 2)[0, 0].tolist() == [25, 10, 50]


def test_masks_keep_their_ids() -> None:
    mask = np.random.default_rng(1).integers(0, 60000, (20, 30)).astype(np.uint16)
    np.testing.assert_array_equal(resize_mask(mask, 15, 10), mask[::2, ::2])
    np.testing.assert_array_equal(resize_mask(mask, 10, 20), mask[:, 1::3])
    np.testing.assert_array_equal(resize_mask(mask, 60, 40)[1::2, ::2], mask)
    assert set(np.unique(resize_mask(mask, 17, 13))) <= set(np.unique(mask))
