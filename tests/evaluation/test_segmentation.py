# SPDX-License-Identifier: Apache-2.0
"""Every score of masks against an example worked out by hand, and the rules for ids that are missing or renamed."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from ggslam.evaluation.segmentation import SegmentationCounts, boundary_band, boundary_distance


def ids(*rows: str) -> np.ndarray:
    """An id image from rows of digits."""
    return np.array([[int(c) for c in row] for row in rows], np.uint16)


def scored(predicted: np.ndarray, truth: np.ndarray, matching: str = "auto", boundary: float | None = 0.02):
    counts = SegmentationCounts(boundary)
    counts.add(predicted, truth)
    return counts.scores(matching)


def patches(rng: np.random.Generator, count: int, size: tuple[int, int] = (60, 80)) -> np.ndarray:
    """An image of `count` blobs with ids 1 to count, each at least 2 pixels large."""
    points = rng.uniform(0, 1, (count, 2)) * size
    grid = np.stack(np.mgrid[: size[0], : size[1]], -1)
    image = ((grid[:, :, None] - points) ** 2).sum(-1).argmin(-1).astype(np.uint16) + 1
    return image


TRUTH = ids("11112222",
            "11112222",
            "11112222",
            "33330000")  # fmt: skip
PREDICTED = ids("11122222",
                "11122222",
                "11112220",
                "22224444")  # fmt: skip


def test_scores_of_a_small_example() -> None:
    # Object 1: 10 of 12 pixels, nothing else: 10/12. Object 2: 11 of 12, and 2 + 4 false ones: 11/18. Object 3: none.
    # Id 4 is predicted on unlabelled pixels only and does not count.
    s = scored(PREDICTED, TRUTH, "same")
    assert s.per_object[1].iou == pytest.approx(10 / 12) and s.per_object[1].pixels == 12
    assert s.per_object[2].iou == pytest.approx(11 / 18)
    assert s.per_object[3].iou == 0 and s.per_object[3].matched == 0 and s.per_object[3].boundary_iou == 0
    assert s.miou == pytest.approx((10 / 12 + 11 / 18) / 3)
    assert s.accuracy == pytest.approx(21 / 28)
    assert (s.frames, s.objects, s.predicted_objects) == (1, 3, 2)
    assert s.precision == 1 and s.recall == pytest.approx(2 / 3) and s.f1 == pytest.approx(0.8)
    assert s.panoptic_quality == pytest.approx((10 / 12 + 11 / 18) / 2 * 0.8)


def test_views_are_added_up_before_the_ratio_is_taken() -> None:
    counts = SegmentationCounts()
    counts.add(ids("11"), ids("11"))
    counts.add(ids("0000"), ids("1111"))
    assert counts.scores().miou == pytest.approx(2 / 6)
    assert counts.scores().frames == 2


def test_an_object_that_nothing_reaches_by_half_is_not_found() -> None:
    s = scored(ids("1100"), ids("1111"), "same")
    assert s.miou == pytest.approx(0.5) and s.recall == 0 and s.precision == 0 and s.panoptic_quality == 0


def test_boundary_iou_by_hand() -> None:
    # 12x12 with the object in columns 2-9 of rows 2-9, predicted one column to the right. Distance 1.
    truth, predicted = np.full((12, 12), 9, np.uint16), np.full((12, 12), 9, np.uint16)
    truth[2:10, 2:10], predicted[2:10, 3:11] = 1, 1
    assert boundary_distance(truth.shape, 0.06) == 1
    s = scored(predicted, truth, "same", boundary=0.06)
    # Rings of 28 pixels each; in common: 7 on the upper and 7 on the lower edge. The vertical edges miss each other.
    assert s.per_object[1].boundary_iou == pytest.approx(14 / (28 + 28 - 14))
    assert s.per_object[1].iou == pytest.approx(56 / 72)


def test_boundary_bands_are_masks_less_their_erosion() -> None:
    image = patches(np.random.default_rng(0), 9)
    image[10:20, 30:50] = 0
    for distance in (1, 3):
        band = boundary_band(image, distance)
        for name in range(1, 10):
            mask = np.pad((image == name).astype(np.uint8), 1)
            eroded = cv2.erode(mask, np.ones((3, 3), np.uint8), iterations=distance)
            assert ((band & (image == name)) == ((mask - eroded) > 0)[1:-1, 1:-1]).all()


def test_a_rim_of_unlabelled_pixels_is_not_held_against_the_prediction() -> None:
    truth = np.full((20, 20), 1, np.uint16)
    truth[:, 8:] = 0
    s = scored(np.ones((20, 20), np.uint16), truth)
    assert s.miou == 1 and s.boundary_miou == 1 and s.accuracy == 1


def test_ids_that_are_renamed_score_the_same() -> None:
    rng = np.random.default_rng(1)
    truth = patches(rng, 12)
    predicted = np.roll(truth, 2, axis=1)
    predicted[:20] = np.roll(truth, 5, axis=0)[:20]
    renamed = np.append(np.uint16(0), rng.permutation(np.arange(1, 13)) + 100).astype(np.uint16)
    plain, shuffled = scored(predicted, truth), scored(renamed[predicted], truth)
    assert plain.matching == "same" and shuffled.matching == "assignment"
    assert shuffled.miou == pytest.approx(plain.miou) and shuffled.boundary_miou == pytest.approx(plain.boundary_miou)
    assert shuffled.accuracy == pytest.approx(plain.accuracy) and shuffled.recall == plain.recall
    assert {t: o.matched for t, o in shuffled.per_object.items()} == {t: renamed[t] for t in range(1, 13)}
    assert scored(renamed[predicted], truth, "same").miou == 0


def test_an_assignment_is_one_to_one() -> None:
    # The prediction does not tell objects 1 and 2 apart: only one of them can have it.
    s = scored(ids("777777"), ids("111122"), "assignment")
    assert s.per_object[1].iou == pytest.approx(4 / 6) and s.per_object[2].iou == 0 and s.per_object[2].matched == 0


def test_a_matching_of_a_larger_set_is_kept_in_a_smaller_one() -> None:
    whole, part = SegmentationCounts(), SegmentationCounts()
    part.add(ids("5566"), ids("1122"))
    whole.merge(part)
    whole.add(np.repeat(ids("6655"), 9, 0), np.repeat(ids("1122"), 9, 0))
    matching = whole.match("assignment")
    assert matching.predicted == {1: 6, 2: 5}
    assert part.scores(matching).miou == 0 and part.scores("assignment").miou == 1
    assert whole.scores(matching).miou == pytest.approx(18 / 22)


def test_merged_counts_are_those_of_all_views() -> None:
    rng = np.random.default_rng(2)
    views = [(np.roll(t, 3, axis=1), t) for t in (patches(rng, 6) for _ in range(4))]
    together, merged = SegmentationCounts(), SegmentationCounts()
    for predicted, truth in views:
        together.add(predicted, truth)
        one = SegmentationCounts()
        one.add(predicted, truth)
        merged.merge(one)
    assert merged.scores() == together.scores()


def test_nothing_to_score() -> None:
    nothing = SegmentationCounts().scores()
    empty = scored(ids("123"), ids("000"))
    for s in (nothing, empty):
        assert math.isnan(s.miou) and math.isnan(s.accuracy) and math.isnan(s.precision) and s.objects == 0
    blind = scored(ids("000"), ids("122"))
    assert blind.miou == blind.accuracy == blind.recall == blind.boundary_miou == 0 and math.isnan(blind.precision)
    assert blind.matching == "same"


def test_without_boundary() -> None:
    s = scored(PREDICTED, TRUTH, boundary=None)
    assert math.isnan(s.boundary_miou) and s.miou > 0


def test_wrong_images_are_refused() -> None:
    counts = SegmentationCounts()
    with pytest.raises(ValueError, match="sizes differ"):
        counts.add(np.zeros((4, 5), np.uint16), np.zeros((5, 4), np.uint16))
    with pytest.raises(ValueError, match="truth: .*uint16"):
        counts.add(np.zeros((4, 5), np.uint16), np.zeros((4, 5), np.int32))
    with pytest.raises(ValueError, match="predicted"):
        counts.add(np.zeros((4, 5, 1), np.uint16), np.zeros((4, 5), np.uint16))
    with pytest.raises(ValueError, match="best"):
        counts.match("best")
    assert counts.frames == 0


def test_a_thousand_ids_up_to_the_largest() -> None:
    rng = np.random.default_rng(3)
    truth = np.kron(np.arange(65535 - 999, 65536).reshape(25, 40), np.ones((8, 8))).astype(np.uint16)
    predicted = truth.copy()
    predicted[rng.random(truth.shape) < 0.1] = 0
    counts = SegmentationCounts()
    for _ in range(3):
        counts.add(predicted, truth)
    s = counts.scores("assignment")
    assert s.objects == 1000 and s.recall == 1 and s.miou == pytest.approx(0.9, abs=0.01) and s.accuracy < 0.92
    assert 65535 in s.per_object
