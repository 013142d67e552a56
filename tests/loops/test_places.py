# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np
import pytest

from ggslam.errors import FormatError
from ggslam.features.orb import FeatureView
from ggslam.loops.places import PlaceIndex
from ggslam.scene.camera import Camera

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)


def view(place: int, shift: int = 0, noise: float = 2.0) -> FeatureView:
    """A picture of one of many walls, each with a pattern of its own; the camera moves along it by pixels."""
    coarse = np.random.default_rng(place).integers(0, 256, (15, 30, 3)).astype(np.uint8)
    wall = cv2.resize(coarse, (300, 150), interpolation=cv2.INTER_NEAREST)
    shown = wall[10:130, 40 + shift : 200 + shift].astype(float)
    shown += np.random.default_rng(1000 + place + shift).normal(0, noise, shown.shape)
    depth = np.full((120, 160), 1.0 + 0.1 * (place % 20), np.float32)
    return FeatureView(shown.clip(0, 255).astype(np.uint8), depth, np.eye(4))


@pytest.fixture(scope="module")
def index() -> PlaceIndex:
    """60 keyframes: 20 walls, three neighbouring views of each."""
    index = PlaceIndex(CAMERA)
    for number in range(60):
        index.add(number, index.describe(view(number // 3, 8 * (number % 3))))
    return index


def test_the_same_place_is_found_from_elsewhere(index: PlaceIndex) -> None:
    right = 0
    for place in range(20):
        matches = index.query(index.describe(view(place, 24)), 3)
        assert [m.score for m in matches] == sorted((m.score for m in matches), reverse=True)
        right += sum(m.number // 3 == place for m in matches)
    assert right >= 55


def test_an_unknown_place_scores_less(index: PlaceIndex) -> None:
    known = [index.query(index.describe(view(place, 4)), 1)[0].score for place in range(20)]
    unknown = [max((m.score for m in index.query(index.describe(view(p)), 1)), default=0.0) for p in range(100, 120)]
    assert min(known) > max(unknown)


def test_excluded_keyframes_are_left_out(index: PlaceIndex) -> None:
    place = index.describe(view(5, 4))
    assert index.query(place, 1)[0].number // 3 == 5
    assert all(m.number not in (15, 16, 17) for m in index.query(place, 60, lambda number: number // 3 == 5))
    assert index.query(place, 5, lambda number: True) == []


def test_keyframes_next_in_time_support_each_other() -> None:
    """Of two equal views, the one among its like comes before the one alone."""
    index = PlaceIndex(CAMERA)
    for number, shift in ((0, 0), (1, 8), (2, 16), (50, 8)):
        index.add(number, index.describe(view(7, shift, noise=0.0)))
    for wall in range(20, 40):
        index.add(5 * wall, index.describe(view(wall)))
    matches = {m.number: m.score for m in index.query(index.describe(view(7, 12, noise=0.0)), 4)}
    assert matches[1] > 1.05 * matches[50]


def test_what_is_saved_finds_the_same(index: PlaceIndex) -> None:
    arrays = index.to_arrays()
    assert arrays["descriptors"].dtype == np.uint8 and arrays["points"].dtype == np.float32
    again = PlaceIndex.from_arrays(CAMERA, arrays)
    assert len(again) == len(index) == 60 and 59 in again and 60 not in again
    for place in range(0, 20, 5):
        described = index.describe(view(place, 12))
        assert again.query(described, 5) == index.query(described, 5)
    np.testing.assert_array_equal(again[17].landmarks.points, index[17].landmarks.points)
    again.add(60, index.describe(view(30)))
    assert again.query(index.describe(view(30, 4)), 1)[0].number == 60


def test_damaged_arrays_are_told(index: PlaceIndex) -> None:
    arrays = index.to_arrays()
    for change, message in (
        ({"points": arrays["points"][:-1]}, "'points': .*landmarks"),
        ({"codes": arrays["codes"][:, :-1]}, "'codes': .*uint8"),
        ({"descriptors": arrays["descriptors"][:, 0]}, "'descriptors': .*uint8"),
        ({"counts": -arrays["counts"]}, "'counts': .*\\b0\\b"),
        ({"numbers": 0 * arrays["numbers"]}, "keyframe"),
        ({"points": arrays["points"] * np.float32(np.inf)}, "'points': .*finite"),
    ):
        with pytest.raises(FormatError, match=message):
            PlaceIndex.from_arrays(CAMERA, {**arrays, **change})
    del arrays["numbers"]
    with pytest.raises(FormatError, match="'numbers'"):
        PlaceIndex.from_arrays(CAMERA, arrays)


def test_views_without_features_or_depth_are_no_places() -> None:
    index = PlaceIndex(CAMERA)
    empty = PlaceIndex.from_arrays(CAMERA, index.to_arrays())
    blank = FeatureView(np.zeros((120, 160, 3), np.uint8), np.ones((120, 160), np.float32), np.eye(4))
    blind = FeatureView(view(0).color, np.zeros((120, 160), np.float32), np.eye(4))
    for number, nothing in enumerate((blank, blind)):
        place = index.describe(nothing)
        assert len(place.landmarks) == 0
        index.add(number, place)
        assert index.query(place, 3) == empty.query(place, 3) == []
    index.add(2, index.describe(view(0)))
    assert [m.number for m in index.query(index.describe(view(0, 4)), 3)] == [2]
    with pytest.raises(ValueError, match="keyframe 2"):
        index.add(2, index.describe(view(0)))
