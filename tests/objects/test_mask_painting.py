# SPDX-License-Identifier: Apache-2.0
"""Overlapping masks become one image of segments."""

from __future__ import annotations

import numpy as np

from ggslam.objects.mask_painting import distinct_masks, paint_segments


def box(left: int, top: int, right: int, bottom: int, size: tuple[int, int] = (20, 30)) -> np.ndarray:
    mask = np.zeros(size, bool)
    mask[top:bottom, left:right] = True
    return mask


def test_like_masks_go_by_score() -> None:
    masks = np.stack([box(0, 0, 10, 10), box(0, 0, 10, 9), box(5, 0, 15, 10), box(0, 0, 0, 0)])
    scores = np.array([0.5, 0.9, 0.7, 1.0])
    assert distinct_masks(masks, scores, 0.8).tolist() == [1, 2]  # overlap of the first two: 0.9
    assert distinct_masks(masks, scores, 0.95).tolist() == [1, 2, 0]
    assert distinct_masks(masks, scores, 0.32).tolist() == [1, 2]  # of the two best: 45 of 145 pixels
    assert distinct_masks(masks, scores, 0.3).tolist() == [1]
    assert distinct_masks(masks[:0], scores[:0], 0.5).tolist() == []


def test_small_on_top_in_any_order() -> None:
    table, plate, cup = box(0, 0, 30, 20), box(5, 5, 20, 15), box(8, 8, 12, 12)
    expected = 1 + plate.astype(int) + cup
    for masks in ([table, plate, cup], [cup, table, plate], [plate, cup, table]):
        painted = paint_segments(masks, 1)
        assert painted.dtype == np.uint16
        np.testing.assert_array_equal(painted, expected)


def test_small_and_covered_masks_are_left_out() -> None:
    large, inner, dot = box(0, 0, 10, 10), box(0, 0, 10, 9), box(20, 10, 22, 12)
    painted = paint_segments([dot, large, inner], 11)
    np.testing.assert_array_equal(painted, inner)  # ten pixels of the large one remain in sight, the dot has four
    np.testing.assert_array_equal(paint_segments([dot, large, inner], 10), 2 * inner + (large & ~inner))
    assert not paint_segments([dot], 5).any()
