# SPDX-License-Identifier: Apache-2.0
"""Making images smaller."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.scene.camera import Camera
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
        assert set(np.unique(resize_depth(z, *size).round(5))) <= {np.float32(1.0), np.float32(3.0)}


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
    np.testing.assert_array_equal(resize_mask(mask, 10, 20), mask[:, 1::3])
    small = resize_mask(mask, 15, 10)
    four = np.stack([mask[y::2, x::2] for y in (0, 1) for x in (0, 1)])
    assert (four == small).any(0).all()
    np.testing.assert_array_equal(resize_mask(mask, 60, 40)[1::2, ::2], mask)
    assert set(np.unique(resize_mask(mask, 17, 13))) <= set(np.unique(mask))


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_outlines_stay_where_they_are_in_smaller_masks(factor: int) -> None:
    y, x = np.mgrid[0:240, 0:240] + 0.5
    disc = ((x - 121.3) ** 2 + (y - 118.4) ** 2 < 37.7**2).astype(np.uint16)
    small = resize_mask(disc, 240 // factor, 240 // factor)
    rows, columns = np.nonzero(small)
    assert np.hypot(columns.mean() + 0.5 - 121.3 / factor, rows.mean() + 0.5 - 118.4 / factor) < 0.06
    assert small.sum() == pytest.approx(np.pi * (37.7 / factor) ** 2, rel=0.02)


def test_a_pixel_takes_the_id_that_most_of_it_has() -> None:
    mask = np.array([[5, 5, 7, 7, 1, 2], [5, 7, 7, 5, 3, 4]] * 3, np.uint16)
    mask[2:4, 4:] = 9
    assert resize_mask(mask, 3, 3).tolist() == [[5, 7, 1], [5, 7, 9], [5, 7, 1]]
    assert resize_mask(mask, 3, 3, shared=False).tolist() == [[5, 7, 0], [5, 7, 9], [5, 7, 0]]


def test_what_two_things_share_half_and_half_is_theirs_by_turns_or_nobodys() -> None:
    mask = np.full((8, 8), 3, np.uint16)
    mask[:, 3:] = 4
    assert resize_mask(mask, 4, 4)[:, 1].tolist() == [4, 3, 4, 3]
    assert resize_mask(mask, 4, 4, shared=False).tolist() == [[3, 0, 4, 4]] * 4
    assert (resize_mask(mask, 8, 8, shared=False) == mask).all()


@pytest.mark.parametrize("factor", [0.9, 0.8, 0.7, 0.6, 0.55, 0.4, 0.37, 0.33])
def test_a_plane_keeps_its_depth_at_any_factor(factor: float) -> None:
    """Depth of a slanted plane on fewer pixels is what a camera of so many pixels sees of it, to a hundredth of a
    millimetre; by samples that are not of the pixels' centres it was off by 0.3 to 0.7 mm."""
    camera = Camera(320, 240, 240, 241, 158.3, 121.7)
    normal = np.array([0.35, -0.25, 0.9])

    def seen_by(camera: Camera) -> np.ndarray:
        return (2 / (camera.rays().astype(np.float64) @ normal)).astype(np.float32)

    small = camera.scale(factor)
    error = resize_depth(seen_by(camera), small.width, small.height) - seen_by(small)
    assert np.abs(error).max() < 1e-5


@pytest.mark.parametrize("factor", [0.8, 0.6, 0.4])
def test_any_factor_keeps_holes_and_edges(factor: float) -> None:
    """A pixel is of one surface, the nearest that covers a part of it; where more than half is a hole, it is one."""
    z = np.full((60, 90), 1.0, np.float32)
    z[:, 41:] = 3.0
    z[20:31] = 0
    width, height = round(90 * factor), round(60 * factor)
    small = resize_depth(z, width, height)
    assert set(np.unique(small.round(5))) == {np.float32(0), np.float32(1), np.float32(3)}
    rows, columns = (np.arange(height) + 0.5) / factor, (np.arange(width) + 0.5) / factor
    half = 0.5 / factor
    inside = (rows > 20 + half) & (rows < 31 - half)
    outside = (rows < 20 - half) | (rows > 31 + half)
    assert (small[inside] == 0).all() and (small[outside] > 0).all()
    assert (small[outside][:, columns < 41 - half].round(5) == 1).all()
    assert (small[outside][:, columns > 41 + half].round(5) == 3).all()
