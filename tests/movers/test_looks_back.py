# SPDX-License-Identifier: Apache-2.0
"""Keyframes that are looked at again all at once, held against a look at each by itself."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import FrameType

import numpy as np
import pytest

from ggslam.geometry.image_parts import parts_with_seeds
from ggslam.mapping.keyframe import Keyframe, make_keyframe
from ggslam.mapping.pruning import blank_part
from ggslam.movers.detector import DetectorTuning, coarse_factor, grow
from ggslam.movers.segments import Gathering, gather
from ggslam.movers.settings import MoverSettings
from ggslam.movers.trail import TrailTuning
from ggslam.native.loader import NativeContext, available_instruction_sets
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.scene.poses import inverse, se3_exp
from ggslam.sight.places import CoarseView, compare
from ggslam.slam.filters.movers import MoverFilter

CAMERA, SMALL = Camera(213, 160, 170.0, 171.0, 105.0, 81.0), Camera(96, 80, 90.0, 90.0, 47.0, 39.0)


def looked_at_one_by_one(
    found_by: MoverFilter, earlier: list[Keyframe], newest: Frame, T_world_newest: np.ndarray
) -> list[np.ndarray | None]:
    """What `MoverFilter.gone_since` finds."""
    settings, trail, margin, context = found_by.detector.settings, found_by.detector.trail, found_by._margin, CONTEXT
    factor, found = coarse_factor(newest.camera, settings), list[np.ndarray | None]()
    view = CoarseView.of(newest.depth, newest.camera, factor, T_world_newest, margin, context)
    for k in earlier:
        found.append(None)
        if k.depth.shape != newest.depth.shape:
            continue
        old = CoarseView.of(k.depth_m(), newest.camera, factor, k.T_world_camera, margin, context)
        near = trail.contains(old)
        if near.sum() < settings.min_pixels / 4:
            continue
        (evidence,) = compare(old, [view], margin, context)
        passed = parts_with_seeds(evidence.passed & near, evidence.passed, TrailTuning.min_in_trail)
        if passed.sum() < settings.min_pixels / 4:
            continue
        rests, shape = np.zeros(passed.shape, bool), k.depth.shape
        places = Gathering(passed, rests, old.depth > 0, rests, rests, old.depth, evidence.same, factor, shape)
        gone = gather(places, lambda mask=k.mask: mask, settings)  # type: ignore[misc]
        if gone is not None:
            found[-1] = grow(gone.full > 0, DetectorTuning.mask_margin)
    return found


CONTEXT = NativeContext(2)


def look_back(
    found_by: MoverFilter, earlier: list[Keyframe], newest: Frame, T_world_newest: np.ndarray
) -> list[np.ndarray | None]:
    """`MoverFilter.gone_since`."""
    return found_by.gone_since(earlier, np.array([k.T_world_camera for k in earlier]), newest, T_world_newest)


@dataclass
class Box:
    """The front of something before a wall: its place in the image of a camera at the origin, and its distance."""

    rows: slice
    columns: slice
    distance: float


class Room:
    """A wall, boxes before it some of which have gone at the end, and keyframes about the origin."""

    def __init__(self, seed: int, camera: Camera = CAMERA) -> None:
        self.rng, self.camera = np.random.default_rng(seed), camera
        self.boxes = [self._box() for _ in range(9)]

    def _box(self) -> Box:
        h, w = self.camera.height, self.camera.width
        top, left = self.rng.integers(0, h - 8), self.rng.integers(0, w - 8)
        high, wide = self.rng.integers(3, h // 3), self.rng.integers(3, w // 3)
        return Box(slice(top, top + high), slice(left, left + wide), float(self.rng.uniform(0.7, 2.8)))

    def frame(self, n: int, boxes: int, masks: bool) -> Frame:
        """What a camera about the origin sees of the last so many boxes."""
        h, w = self.camera.height, self.camera.width
        rows, columns = np.mgrid[:h, :w].astype(np.float32)
        depth, mask = 3 + 0.5 * columns / w - 0.3 * rows / h, np.zeros((h, w), np.uint16)
        for number, box in enumerate(self.boxes[len(self.boxes) - boxes :], start=1):
            depth[box.rows, box.columns], mask[box.rows, box.columns] = box.distance, number
        depth += self.rng.normal(0, 0.002, depth.shape) * depth
        depth[self.rng.random(depth.shape) < 0.01] = 0
        color = np.zeros((h, w, 3), np.uint8)
        return Frame(n, n, n / 30, color, depth.astype(np.float32), self.camera, mask if masks else None)

    def keyframe(self, n: int, boxes: int, masks: bool) -> Keyframe:
        """Of such a frame."""
        return make_keyframe(n, self.frame(n, boxes, masks), self.pose())

    def pose(self) -> np.ndarray:
        """Of a camera about the origin."""
        return se3_exp(np.concatenate([self.rng.normal(0, 0.01, 3), self.rng.normal(0, 0.005, 3)]))

    def add_to(self, found_by: MoverFilter, keyframe: Keyframe, boxes: int) -> None:
        """The trail gets what a keyframe shows where the first so many boxes are."""
        factor = coarse_factor(self.camera, found_by.detector.settings)
        view = CoarseView.of(
            keyframe.depth_m(), self.camera, factor, keyframe.T_world_camera, found_by._margin, CONTEXT
        )
        places = np.zeros((self.camera.height, self.camera.width), bool)
        for box in self.boxes[:boxes]:
            places[box.rows, box.columns] = True
        h, w = view.depth.shape
        found_by.detector.trail.add(view, places[::factor, ::factor][:h, :w])


def agree(found: list[np.ndarray | None], expected: list[np.ndarray | None]) -> bool:
    """Whether the same was found in each."""
    return len(found) == len(expected) and all(
        (one is None and other is None) or (one is not None and other is not None and np.array_equal(one, other))
        for one, other in zip(found, expected, strict=True)
    )


@pytest.mark.parametrize("name", available_instruction_sets())
@pytest.mark.parametrize("threads", [1, 3])
def test_the_same_is_found_as_by_a_look_at_each(threads: int, name: str) -> None:
    context, counts = NativeContext(threads, name), np.zeros(2, int)
    for seed in range(12):
        room, smaller = Room(seed), Room(seed, SMALL)
        found_by = MoverFilter(MoverSettings(min_pixels=8 if seed % 3 else 30), True, context)
        earlier = [room.keyframe(n, 9, masks=(n + seed) % 2 == 0) for n in range(8)]
        earlier.insert(3, smaller.keyframe(8, 9, masks=True))
        for n in range(9, 14):
            newest, T = room.frame(n, 9 - seed % 4, masks=False), room.pose()
            expected = looked_at_one_by_one(found_by, earlier, newest, T)
            assert agree(look_back(found_by, earlier, newest, T), expected)
            gone = [part for part in expected if part is not None]
            counts += len(gone), len(expected) - len(gone)
            # What is remembered of keyframes has to follow: the trail grows, depth is blanked, poses and noise change.
            room.add_to(found_by, earlier[(n - 9) % 3], n - 8)
            for k, part in zip(earlier, expected, strict=True):
                if part is not None and n % 2:
                    blank_part(k, part)
            earlier[1].T_camera_world = inverse(room.pose())
            if n == 12:
                found_by._margin = replace(found_by._margin, constant=0.003)
            earlier.append(make_keyframe(n, newest, T))
    assert counts.min() > 40


def test_images_of_several_sizes_are_looked_at_with_their_own() -> None:
    rooms = [Room(1), Room(1, SMALL)]
    found_by = MoverFilter(MoverSettings(), True, CONTEXT)
    earlier = [rooms[n % 2].keyframe(n, 9, masks=False) for n in range(6)]
    for room, keyframe in zip(rooms, earlier, strict=False):
        room.add_to(found_by, keyframe, 4)
    for n in range(6, 10):
        newest, T = rooms[n % 2].frame(n, 5, masks=False), rooms[n % 2].pose()
        found = look_back(found_by, earlier, newest, T)
        assert agree(found, looked_at_one_by_one(found_by, earlier, newest, T))
        assert any(part is not None for part in found)
        assert all(part is None for part in found[1 - n % 2 :: 2])
    other = Room(1, Camera(64, 48, 50.0, 50.0, 31.5, 23.5)).frame(10, 5, masks=False)
    assert look_back(found_by, earlier, other, np.eye(4)) == [None] * 6


def calls_of(look: Callable[[], object]) -> int:
    """How many functions of Python it calls."""
    calls = 0

    def count(_: FrameType, event: str, __: object) -> None:
        nonlocal calls
        calls += event == "call"

    sys.setprofile(count)
    try:
        look()
    finally:
        sys.setprofile(None)
    return calls


def test_a_look_calls_no_more_functions_with_more_keyframes() -> None:
    room, found_by = Room(3), MoverFilter(MoverSettings(), True, CONTEXT)
    earlier = [room.keyframe(n, 9, masks=False) for n in range(48)]
    room.add_to(found_by, earlier[0], 9)
    for k in earlier[1:]:  # all see the trail, and the newest one as well
        k.depth, k.T_camera_world = earlier[0].depth, earlier[0].T_camera_world
    newest, T = replace(room.frame(48, 9, masks=False), depth=earlier[0].depth_m()), earlier[0].T_world_camera
    counts, poses = [], np.array([k.T_world_camera for k in earlier])
    for number in (3, 48):
        assert look_back(found_by, earlier[:number], newest, T) == [None] * number
        counts.append(calls_of(lambda n=number: found_by.gone_since(earlier[:n], poses[:n], newest, T)))  # type: ignore[misc]
    assert 0 < counts[1] <= counts[0]
