# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe, make_keyframe
from ggslam.objects.table import Observation
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.slam.object_chances import count_chances, typical_points
from ggslam.slam.object_masks import MaskSettings, ObjectMasks

CAMERA = Camera(40, 30, 30.0, 30.0, 19.5, 14.5)


def keyframe(index: int, x: float = 0.0, wall: float = 2.0, masked: bool = True) -> Keyframe:
    """A view along z of a wall, from x metres to the right."""
    mask = np.ones((30, 40), np.uint16) if masked else None
    color, depth = np.zeros((30, 40, 3), np.uint8), np.full((30, 40), wall, np.float32)
    frame = Frame(index, index, 0.0, color, depth, CAMERA, mask)
    T = np.eye(4)
    T[0, 3] = x
    return make_keyframe(index, frame, T)


def test_the_typical_point_is_a_gaussian_in_the_middle() -> None:
    means = np.array([[0, 0, 1], [1, 0, 1], [2.2, 0, 1], [9, 9, 9], [5, 0, 0]], np.float32)
    found = typical_points(means, np.array([7, 7, 7, 0, 3]))
    assert found.keys() == {3, 7}
    assert np.array_equal(found[7], means[1]) and np.array_equal(found[3], means[4])


def test_chances_are_segmented_keyframes_that_show_the_place() -> None:
    points = {5: np.array([0.0, 0, 2]), 6: np.array([0.0, 0, 2.5]), 8: np.array([0.0, 0, -2])}
    elsewhere = keyframe(6)
    elsewhere.frame_index = FROM_EARLIER_RUN
    keyframes = [
        keyframe(0), keyframe(1), keyframe(2, masked=False), keyframe(3, x=10), keyframe(4, wall=1.0), keyframe(5),
        elsewhere,
    ]  # fmt: skip
    assert count_chances(points, {}, keyframes) == {5: 3, 6: 0, 8: 0}
    assert count_chances(points, {5: 1}, keyframes)[5] == 2
    assert count_chances({}, {}, keyframes) == {}


def test_what_is_found_seldom_where_it_could_be_seen_is_noise() -> None:
    masks = ObjectMasks(MaskSettings(source="geometry"))
    seen = {i: Observation(0, 90, 4) for i in (1, 2, 3)}
    sizes = np.full(65536, 100)
    ids = np.array([1, 2, 3])
    assert masks.noise(ids, seen, 40, sizes, {1: 5, 2: 20}) == [2]
    assert masks.noise(ids, seen, 40, sizes, {}) == []
    everything = ObjectMasks(MaskSettings(source="geometry", min_repeat=0))
    assert everything.noise(ids, seen, 40, sizes, {2: 20}) == []


def test_large_things_that_were_found_whenever_in_view_need_no_second_look() -> None:
    masks = ObjectMasks(MaskSettings(source="geometry"))
    sizes = np.zeros(65536, int)
    sizes[1:6] = 300, 300, 300, 30, 30
    seen = {i: Observation(0, 0, views) for i, views in {1: 1, 2: 1, 3: 1, 4: 1, 5: 9}.items()}
    noise = masks.noise(np.array([1, 2, 3, 4, 5]), seen, 40, sizes, {1: 1, 2: 2, 3: 0, 4: 1, 5: 9})
    assert noise == [2, 3, 4]  # not found again; where it was is not known; small
    every = ObjectMasks(MaskSettings(source="geometry", min_gaussians=0))
    assert every.noise(np.array([1, 4]), seen, 40, sizes, {1: 1, 4: 1}) == [4]


def test_objects_of_an_earlier_map_are_judged_by_their_size_alone() -> None:
    masks = ObjectMasks(MaskSettings(source="geometry"))
    sizes = np.zeros(65536, int)
    sizes[1:4] = 300, 300, 3
    seen = {i: Observation(103, 109, 2) for i in (1, 2, 3)}
    assert masks.noise(np.array([1, 2, 3]), seen, 34, sizes, {1: 0, 2: 0, 3: 0}, known=(1, 3)) == [2, 3]


def test_a_map_without_objects_has_no_typical_points() -> None:
    for count in (0, 5):
        assert typical_points(np.zeros((count, 3)), np.zeros(count, int)) == {}
