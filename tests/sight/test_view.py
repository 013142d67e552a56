# SPDX-License-Identifier: Apache-2.0
"""What views say of places whose truth is known: a wall, a box before it, holes, and what no view can tell."""

from __future__ import annotations

import numpy as np
import pytest
from view_reference import classify

from ggslam.errors import CoreInputError
from ggslam.native.loader import NativeContext, available_instruction_sets
from ggslam.scene.camera import Camera
from ggslam.scene.poses import se3_exp, transform_points
from ggslam.sight.margin import Margin, MarginTuning
from ggslam.sight.view import Sight, View

CAMERA = Camera(64, 48, 50.0, 52.0, 31.0, 24.5)
WALL_M, BOX_M = 3.0, 1.5
BOX = np.zeros((48, 64), bool)
BOX[16:32, 20:40] = True
EXACT = Margin(0.01, 0.0)
POSE = se3_exp(np.array([0.3, -0.2, 0.1, 0.1, 0.4, -0.2]))


def scene() -> np.ndarray:
    """A box before a wall; two pixels without depth."""
    depth = np.where(BOX, np.float32(BOX_M), np.float32(WALL_M))
    depth[5, 5] = depth[24, 30] = 0
    return depth


def places(pixels: list[tuple[int, int]], z: float, T_world_camera: np.ndarray = POSE) -> np.ndarray:
    """World points at a depth before the middles of pixels (row, column)."""
    local = [[(c - CAMERA.cx) / CAMERA.fx * z, (r - CAMERA.cy) / CAMERA.fy * z, z] for r, c in pixels]
    return transform_points(np.array(local), T_world_camera)


WALL_PIXEL, BOX_PIXEL, WALL_EDGE, BOX_EDGE, HOLE, BESIDE_HOLE = (40, 50), (20, 26), (20, 19), (20, 20), (5, 5), (5, 6)


@pytest.mark.parametrize(
    ("pixel", "z", "expected"),
    [
        (WALL_PIXEL, 1.0, Sight.THROUGH), (WALL_PIXEL, 2.985, Sight.THROUGH), (WALL_PIXEL, 2.995, Sight.SAME),
        (WALL_PIXEL, 3.005, Sight.SAME), (WALL_PIXEL, 3.015, Sight.HIDDEN), (BOX_PIXEL, 1.4, Sight.THROUGH),
        (BOX_PIXEL, 1.5, Sight.SAME), (BOX_PIXEL, 2.0, Sight.HIDDEN), (WALL_EDGE, 2.0, Sight.BEFORE),
        (WALL_EDGE, 1.5, Sight.BEFORE), (WALL_EDGE, 1.4, Sight.THROUGH), (WALL_EDGE, 3.2, Sight.HIDDEN),
        (BOX_EDGE, 2.0, Sight.BEHIND), (BOX_EDGE, 3.2, Sight.HIDDEN), (HOLE, 2.0, Sight.UNKNOWN),
        (BESIDE_HOLE, 2.0, Sight.BEFORE), (BESIDE_HOLE, 4.0, Sight.BEHIND), (BESIDE_HOLE, 3.0, Sight.SAME),
        (WALL_PIXEL, -1.0, Sight.OUTSIDE), ((48, 10), 2.0, Sight.OUTSIDE), ((10, -1), 2.0, Sight.OUTSIDE),
        ((0, 0), 1.0, Sight.THROUGH), ((47, 63), 1.0, Sight.THROUGH),
    ],
)  # fmt: skip
def test_a_wall_and_a_box_before_it(pixel: tuple[int, int], z: float, expected: Sight) -> None:
    answers = View.of(scene(), CAMERA, POSE, EXACT).classify_points(places([pixel], z))
    assert answers.codes[0] == expected
    if expected != Sight.OUTSIDE:
        assert answers.pixels[0] == pixel[0] * 64 + pixel[1] and np.isclose(answers.z[0], z)
        assert answers.at(BOX)[0] == BOX[pixel]


@pytest.mark.parametrize("name", available_instruction_sets())
@pytest.mark.parametrize("threads", [1, 3])
def test_answers_are_those_of_the_reference(threads: int, name: str) -> None:
    rng = np.random.default_rng(3)
    depth = (2 + rng.random((48, 64)) * (rng.random((48, 64)) < 0.3)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.05] = 0
    margin = Margin(0.02, 0.01, 3.0, 0.002, 0.003)
    points = transform_points(rng.uniform([-2.5, -2, -0.5], [2.5, 2, 4], (20_000, 3)), POSE)
    expected = classify(points, depth, CAMERA, POSE, margin)
    found = View.of(depth, CAMERA, POSE, margin, NativeContext(threads, name)).classify_points(points)
    assert set(expected.tolist()) == set(range(7))
    assert (found.codes == expected).mean() > 0.9999  # a place may fall on the edge between two pixels


def test_pixels_and_whole_views_are_judged_as_their_points_are() -> None:
    view = View.of(scene(), CAMERA, POSE, EXACT)
    other_depth = np.full((48, 64), 2.0, np.float32)
    other_depth[0] = 0
    along = view.classify_depth(other_depth)
    assert (along[0] == Sight.OUTSIDE).all() and along[40, 50] == Sight.THROUGH and along[20, 26] == Sight.HIDDEN
    other = View.of(other_depth, CAMERA, POSE, EXACT)
    assert np.array_equal(view.classify_view(other), along)
    turned = View.of(other_depth, CAMERA, POSE @ se3_exp(np.array([0.1, 0, 0, 0, 0.1, 0])), EXACT)
    codes = view.classify_points(turned.points()).codes.reshape(48, 64)
    assert np.array_equal(view.classify_view(turned)[1:], codes[1:]) and not np.array_equal(codes[1:], along[1:])
    ahead = View.of(np.zeros((48, 64)), CAMERA, POSE @ se3_exp(np.array([0, 0, 1.0, 0, 0, 0])), EXACT)
    assert not view.classify_view(ahead).any(), "its camera is in view, but it shows nothing"


def test_answers_are_grouped_by_what_the_pixel_itself_shows() -> None:
    """Through, before, same, behind, hidden, unknown, outside."""
    pixels, depths = [WALL_PIXEL, WALL_EDGE, WALL_PIXEL, BOX_EDGE, BOX_PIXEL, HOLE, (48, 0)], [2, 2, 3, 2, 2, 2, 2]
    points = np.concatenate([places([pixel], z) for pixel, z in zip(pixels, depths, strict=True)])
    answers = View.of(scene(), CAMERA, POSE, EXACT).classify_points(points)
    assert answers.before.tolist() == [True, True, False, False, False, False, False]
    assert answers.through.tolist() == [True, False, False, False, False, False, False]
    assert answers.same.tolist() == [False, False, True, False, False, False, False]
    assert answers.behind.tolist() == [False, False, False, True, True, False, False]
    assert answers.inside.tolist() == [True] * 6 + [False]


def test_a_view_that_moves_with_its_world_says_the_same() -> None:
    T = se3_exp(np.array([5.0, -3.0, 40.0, 0.5, 1.0, -0.7]))
    view, points = View.of(scene(), CAMERA, POSE, EXACT), places([WALL_PIXEL, BOX_PIXEL, WALL_EDGE, HOLE], 2.0)
    before = view.classify_points(points).codes
    assert np.array_equal(view.move(T).classify_points(transform_points(points, T)).codes, before)
    assert not np.array_equal(view.move(T).classify_points(points).codes, before)


def test_where_whole_surroundings_are_asked_for_nothing_is_said_beside_holes() -> None:
    view = View.of(scene(), CAMERA, POSE, EXACT, whole_only=True)
    codes = view.classify_points(places([BESIDE_HOLE, WALL_EDGE, WALL_PIXEL], 2.0)).codes
    assert codes.tolist() == [Sight.UNKNOWN, Sight.BEFORE, Sight.THROUGH]


def test_nothing_is_said_of_no_points_and_of_what_is_no_number() -> None:
    view = View.of(scene(), CAMERA, POSE, EXACT)
    assert view.classify_points(np.zeros((0, 3))).codes.shape == (0,)
    strange = np.array([[np.nan, 0, 1], [np.inf, 0, 1], [1e300, 1e300, 1e300]])
    assert not view.classify_points(strange).inside.any()
    empty = View.of(np.zeros((48, 64)), CAMERA, POSE, EXACT)
    assert empty.classify_points(places([WALL_PIXEL], 2.0)).codes.tolist() == [Sight.UNKNOWN]


def test_images_and_poses_that_do_not_fit_are_refused() -> None:
    view = View.of(scene(), CAMERA, POSE, EXACT)
    with pytest.raises(ValueError):
        View.of(scene()[1:], CAMERA, POSE, EXACT)
    with pytest.raises(ValueError):
        view.classify_depth(scene()[:, 1:])
    with pytest.raises(CoreInputError):
        View.of(scene(), CAMERA, np.full((4, 4), np.nan), EXACT).classify_points(np.zeros((1, 3)))
    with pytest.raises(CoreInputError):
        View.of(scene(), CAMERA, POSE, Margin(-1.0)).classify_points(np.zeros((1, 3)))


class _Noise:
    constant, square = 0.001, 0.002


def test_the_margin_grows_with_noise_and_distance() -> None:
    z = np.array([1.0, 4.0])
    assert np.allclose(Margin()(z), [0.02, 0.04])
    assert np.allclose(Margin.of(_Noise())(z), [0.02 + MarginTuning.sigmas * 0.003, 0.04 + MarginTuning.sigmas * 0.033])
    assert np.allclose(Margin.of(_Noise()).times(2.5)(z), 2.5 * Margin.of(_Noise())(z))
    assert Margin.of(_Noise())(z.astype(np.float32)).dtype == np.float32


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0, 4.0])
def test_nearly_all_depths_of_a_noisy_wall_are_of_the_wall(z: float) -> None:
    """And none of what is three margins before or behind it."""
    rng, noise = np.random.default_rng(0), _Noise()
    sigma = noise.constant + noise.square * z * z
    depth = (z + rng.normal(0, sigma, (48, 64))).astype(np.float32)
    margin = Margin.of(noise)
    view = View.of(depth, CAMERA, np.eye(4), margin)
    away = 3 * float(margin(np.array(z)))
    assert (view.classify_depth(np.full((48, 64), z)) == Sight.SAME).mean() > 0.999
    if z > away:
        assert (view.classify_depth(np.full((48, 64), z - away)) == Sight.THROUGH).all()
    assert (view.classify_depth(np.full((48, 64), z + away)) == Sight.HIDDEN).all()
