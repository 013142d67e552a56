# SPDX-License-Identifier: Apache-2.0
"""Views of which places in voxels are looked past, held against each view by itself."""

from __future__ import annotations

from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from test_coarse_views import MARGIN, depth_of, pose_of

from ggslam.errors import CoreInputError
from ggslam.geometry.image_parts import parts_with_seeds
from ggslam.geometry.voxels import voxel_keys
from ggslam.native.loader import NativeContext, available_instruction_sets
from ggslam.scene.camera import Camera
from ggslam.scene.poses import transform_points
from ggslam.sight.passed_voxels import KeptPlaces, find_passed_parts
from ggslam.sight.places import CoarseView, PairEvidence, compare

VOXEL, LEAST_SHARE = 0.1, 0.2


def views_of(camera: Camera, seeds: range, context: NativeContext) -> list[CoarseView]:
    return [CoarseView.of(depth_of(camera, n), camera, 2, pose_of(n), MARGIN, context) for n in seeds]


def keys_of(view: CoarseView) -> np.ndarray:
    """The voxels of each place, int64 [h w]."""
    points = view.camera.back_project(view.depth).reshape(-1, 3)
    return voxel_keys(transform_points(points, view.T_world_camera), VOXEL)


@pytest.mark.parametrize("name", available_instruction_sets())
@pytest.mark.parametrize("threads", [1, 3])
def test_parts_are_those_of_a_view_by_itself(threads: int, name: str) -> None:
    camera, context = Camera(160, 121, 130.0, 131.0, 79.0, 61.0), NativeContext(threads, name)
    without = 0
    for seed in range(0, 60, 6):
        *earlier, newest = views_of(camera, range(seed, seed + 6), context)
        every = np.unique(np.concatenate([keys_of(view) for view in earlier]))
        keys = np.sort(np.random.default_rng(seed).choice(every, len(every) // (40 if seed % 4 else 2), replace=False))
        poses = np.array([view.T_world_camera for view in earlier])
        asked = [KeptPlaces(replace(view, T_world_camera=np.eye(4))) for view in earlier]
        found = find_passed_parts(asked, poses, newest, keys, VOXEL, LEAST_SHARE, MARGIN, context)
        for i, view in enumerate(earlier):
            (evidence,) = compare(view, [newest], MARGIN, context)
            near = np.isin(keys_of(view), keys).reshape(view.depth.shape) & (view.depth > 0)
            parts = parts_with_seeds(evidence.passed & near, evidence.passed, LEAST_SHARE)
            _, labels = cv2.connectedComponents(parts.astype(np.uint8), connectivity=8)
            sizes = np.bincount(labels[parts], minlength=1)
            assert (found.places[i], found.largest[i]) == (parts.sum(), sizes.max())
            without += not parts.any()
            for field in fields(PairEvidence) if parts.any() else ():
                assert np.array_equal(getattr(found.evidence(i), field.name), getattr(evidence, field.name))
    assert 0 < without < 40


def test_without_voxels_nothing_is_found() -> None:
    camera, context = Camera(160, 121, 130.0, 131.0, 79.0, 61.0), NativeContext(1)
    one, newest = views_of(camera, range(2), context)
    nothing = np.empty(0, np.int64)
    found = find_passed_parts(
        [KeptPlaces(one)], one.T_world_camera[None], newest, nothing, VOXEL, LEAST_SHARE, MARGIN, context
    )
    assert found.places.tolist() == [0] and found.largest.tolist() == [0]


def test_what_cannot_be_is_refused() -> None:
    context = NativeContext(1)
    sizes = [Camera(160, 121, 130.0, 131.0, 79.0, 61.0), Camera(64, 48, 50.0, 50.0, 31.5, 23.5)]
    one, other = (views_of(camera, range(1), context)[0] for camera in sizes)
    with pytest.raises(ValueError, match="places: .*60 x 80"):
        KeptPlaces(replace(one, near=one.near[1:]))
    keys, poses = np.zeros(1, np.int64), np.tile(np.eye(4), (2, 1, 1))
    asked = [KeptPlaces(one), KeptPlaces(other)]
    with pytest.raises(CoreInputError, match="height: expected 60"):
        find_passed_parts(asked, poses, one, keys, VOXEL, LEAST_SHARE, MARGIN, context)
    asked, poses = asked[:1], poses[:1]
    with pytest.raises(CoreInputError, match="voxel: expected"):
        find_passed_parts(asked, poses, one, keys, 0.0, LEAST_SHARE, MARGIN, context)
    with pytest.raises(CoreInputError, match="T_world_earlier: expected"):
        find_passed_parts(asked, poses * np.nan, one, keys, VOXEL, LEAST_SHARE, MARGIN, context)
