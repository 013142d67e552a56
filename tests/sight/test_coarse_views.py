# SPDX-License-Identifier: Apache-2.0
"""Places of depth images by the compiled core, held against OpenCV and NumPy."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from places_reference import coarse_view, compare_views

from ggslam.native.loader import NativeContext, available_instruction_sets
from ggslam.scene.camera import Camera
from ggslam.scene.poses import se3_exp
from ggslam.sight.margin import Margin
from ggslam.sight.places import CoarseView, PairEvidence, compare

MARGIN = Margin(0.004, 0.0, 5.0, 0.001, 0.002)
ARRAYS = ("depth", "near", "far", "whole", "smooth")


def depth_of(camera: Camera, seed: int) -> np.ndarray:
    """A tilted wall with boxes before it, noise, holes, and edges without depth."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    depth = 3 + 0.5 * columns / camera.width - 0.3 * rows / camera.height
    for _ in range(6):
        top, left = rng.integers(0, camera.height), rng.integers(0, camera.width)
        high, wide = rng.integers(1, 1 + camera.height // 2), rng.integers(1, 1 + camera.width // 2)
        depth[top : top + high, left : left + wide] = rng.uniform(0.6, 2.8)
    depth += rng.normal(0, 0.002, depth.shape) * depth
    depth[rng.random(depth.shape) < 0.03] = 0
    depth[: camera.height // 9] = 0
    return depth.astype(np.float32)


def pose_of(seed: int) -> np.ndarray:
    rng = np.random.default_rng(100 + seed)
    return se3_exp(np.concatenate([rng.normal(0, 0.05, 3), rng.normal(0, 0.03, 3)]))


@pytest.mark.parametrize("name", available_instruction_sets())
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize(
    "width, height, factor", [(320, 240, 2), (203, 101, 1), (641, 483, 4), (130, 70, 3), (9, 8, 5)]
)
def test_views_are_those_of_the_reference(width: int, height: int, factor: int, threads: int, name: str) -> None:
    camera = Camera(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2)
    context = NativeContext(threads, name)
    for seed in range(3):
        depth, T = depth_of(camera, seed), pose_of(seed)
        found = CoarseView.of(depth, camera, factor, T, MARGIN, context)
        expected = coarse_view(depth, camera, factor, T, MARGIN)
        assert found.camera == expected.camera and np.array_equal(found.T_world_camera, T)
        for array in ARRAYS:
            assert np.array_equal(getattr(found, array), getattr(expected, array)), array


def agreement(found: PairEvidence, expected: PairEvidence) -> float:
    """The least share of places that two agree on."""
    return min(float((getattr(found, f.name) == getattr(expected, f.name)).mean()) for f in fields(PairEvidence))


@pytest.mark.parametrize("name", available_instruction_sets())
@pytest.mark.parametrize("threads", [1, 3])
def test_evidence_is_that_of_the_reference(threads: int, name: str) -> None:
    camera, context = Camera(320, 240, 260.0, 260.0, 159.5, 119.5), NativeContext(threads, name)
    views = [coarse_view(depth_of(camera, seed), camera, 2, pose_of(seed), MARGIN) for seed in range(5)]
    behind = replace(views[1], T_world_camera=se3_exp(np.array([0, 0, 0, 0, 3.1, 0.0])))
    small = Camera(160, 120, 120.0, 125.0, 70.0, 66.0)
    other_camera = coarse_view(depth_of(small, 9), small, 1, pose_of(9), MARGIN)
    others = [*views[1:], behind, other_camera]
    moved = np.zeros(views[0].depth.shape, bool)
    moved[20:60, 30:90] = True
    for told in (None, moved):
        found = compare(views[0], others, MARGIN, context, told)
        for pair, other in zip(found, others, strict=True):
            expected = compare_views(views[0], other, MARGIN, told)
            assert agreement(pair, expected) > 0.9995  # a place may fall on the edge between two
        assert found[0].passed.any() and found[0].surely.any() and found[0].same.any() and found[0].otherwise.any()
        assert not found[-2].same.any()


def test_without_views_and_without_depth_nothing_is_said() -> None:
    camera, context = Camera(64, 48, 50.0, 50.0, 31.5, 23.5), NativeContext(1)
    empty = CoarseView.of(np.zeros((48, 64), np.float32), camera, 2, np.eye(4), MARGIN, context)
    assert (empty.near > 1e30).all() and not empty.far.any() and not empty.whole.any()
    assert compare(empty, [], MARGIN, context) == []
    (found,) = compare(empty, [empty], MARGIN, context)
    assert not any(getattr(found, f.name).any() for f in fields(PairEvidence))


def test_arrays_that_do_not_fit_their_camera_are_refused() -> None:
    camera, context = Camera(64, 48, 50.0, 50.0, 31.5, 23.5), NativeContext(1)
    view = CoarseView.of(depth_of(camera, 0), camera, 2, np.eye(4), MARGIN, context)
    for array in ARRAYS:
        cut = replace(view, **{array: getattr(view, array)[:-1]})
        for one, other in ((view, cut), (cut, view)):
            with pytest.raises(ValueError, match="places: .*24 x 32"):
                compare(one, [other], MARGIN, context)
    with pytest.raises(ValueError, match="places: .*24 x 32"):
        compare(view, [view], MARGIN, context, np.zeros((24, 31), bool))
