# SPDX-License-Identifier: Apache-2.0
"""What views say of what is fixed to the camera, against a slow reference made of views' answers."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.abi.arrays import address
from ggslam.errors import CoreInputError
from ggslam.native.loader import load_library
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, se3_exp, transform_points
from ggslam.sight.fixed_to_camera import FixedTuning, count_comparisons, shrink_depth
from ggslam.sight.margin import Margin
from ggslam.sight.view import Sight, View

CAMERA = Camera(40, 30, 33.0, 34.0, 19.2, 15.1)


def reference(depth: np.ndarray, other: np.ndarray, T_other_camera: np.ndarray) -> np.ndarray:
    """What `other` says of the pixels of a view: fixed, still, world, bool [3, h, w]."""
    usual = Margin.usual()
    moved = transform_points(CAMERA.back_project(depth).reshape(-1, 3).astype(float), T_other_camera)
    z = np.maximum(moved[:, 2], 1e-3)
    u, v = CAMERA.fx * moved[:, 0] / z + CAMERA.cx, CAMERA.fy * moved[:, 1] / z + CAMERA.cy
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    shift = np.hypot(u.reshape(depth.shape) - columns, v.reshape(depth.shape) - rows)
    moves = (depth > 0) & (shift > FixedTuning.min_shift * CAMERA.width)
    strict, wide = (View.of(other, CAMERA, np.eye(4), margin) for margin in (usual, usual.times(3)))
    still = moves & (strict.classify_depth(depth) == Sight.SAME)
    past = wide.classify_points(moved).before.reshape(depth.shape)
    return np.stack([still & past, still, moves & strict.classify_points(moved).same.reshape(depth.shape)])


def scene(rng: np.random.Generator) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Depth and poses of views of a bumpy wall, some of it not known, with a tool before it."""
    depths, poses = [], []
    for _ in range(4):
        depth = 2 + 0.02 * rng.normal(size=(30, 40)) + 0.5 * (rng.random((30, 40)) < 0.1)
        depth[rng.random((30, 40)) < 0.1] = 0
        depth[:12, 25:] = 0.3
        depths.append(depth.astype(np.float32))
        poses.append(se3_exp(rng.normal(size=6) * [0.3, 0.3, 0.3, 0.1, 0.1, 0.1]))
    return depths, poses


@pytest.mark.parametrize("seed", range(8))
def test_counts_are_those_of_the_reference(seed: int) -> None:
    depths, poses = scene(np.random.default_rng(seed))
    expected = np.full((3, 30, 40), 5, np.int32)
    counts = expected.copy()
    for depth, pose in zip(depths[:-1], poses[:-1], strict=True):
        T_earlier_newest = inverse(pose) @ poses[-1]
        expected += reference(depths[-1], depth, T_earlier_newest)
        expected += reference(depth, depths[-1], inverse(T_earlier_newest))
    count_comparisons(depths[-1], poses[-1], list(zip(depths, poses, strict=True))[:-1], CAMERA, counts)
    assert np.array_equal(counts, expected)
    assert all((of_one > 5).sum() > 20 for of_one in counts)


def test_what_cannot_be_is_refused() -> None:
    (depth, other), T = scene(np.random.default_rng(0))[0][:2], np.eye(4)
    counts = np.zeros((3, 30, 40), np.int32)
    with pytest.raises(ValueError, match="expected depth"):
        count_comparisons(depth, T, [(other[1:], T)], CAMERA, counts)
    with pytest.raises(ValueError, match="expected counts"):
        count_comparisons(depth, T, [(other, T)], CAMERA, counts[:2])
    with pytest.raises(CoreInputError, match="T_world_camera"):
        count_comparisons(depth, T, [(other, np.full((4, 4), np.nan))], CAMERA, counts)
    assert not counts.any()


@pytest.mark.parametrize("factor", [1, 2, 4, 7, 30])
def test_small_depth_is_the_nearest_known_of_each_cell(factor: int) -> None:
    depth = np.random.default_rng(0).uniform(0.5, 3, (30, 40)).astype(np.float32)
    depth[depth < 1] = 0
    depth[:8, :8] = 0
    depth[9, 9:12], depth[10, 11], depth[11, 12] = (np.nan, np.inf, 1), -1, np.inf
    found, camera = shrink_depth(depth, CAMERA, factor)
    for i, j in np.ndindex(30 // factor, 40 // factor):
        cell = depth[i * factor : (i + 1) * factor, j * factor : (j + 1) * factor]
        known = cell[(cell > 0) & np.isfinite(cell)]
        assert found[i, j] == (known.min() if len(known) else 0)
    assert found.shape == (camera.height, camera.width) == (30 // factor, 40 // factor)
    assert found.dtype == np.float32


def test_depth_that_cannot_be_made_smaller_is_refused() -> None:
    depth = np.ones((30, 40), np.float32)
    with pytest.raises(ValueError, match="expected depth"):
        shrink_depth(depth[:-1], CAMERA, 2)
    for factor in (0, 31):
        with pytest.raises(CoreInputError, match="factor"):
            load_library().ggslam_shrink_depth(address(depth), 30, 40, factor, address(depth))
    with pytest.raises(CoreInputError, match="depth"):
        load_library().ggslam_shrink_depth(None, 30, 40, 2, address(depth))
