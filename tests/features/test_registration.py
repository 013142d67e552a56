# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ggslam.features.orb import FeatureSettings, FeatureView, Landmarks
from ggslam.features.registration import RegistrationSettings, pixels_of, register
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, se3_exp, se3_log

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
SETTINGS = RegistrationSettings()
T_OLD_NEW = se3_exp(np.array([0.4, -0.1, 0.2, 0.05, -0.25, 0.1]))


def landmarks(wrong: float, seed: int = 0, count: int = 120) -> tuple[Landmarks, Landmarks]:
    """Both views' landmarks of one scene; a share of the matches is wrong, depth has 5 mm of noise."""
    random = np.random.default_rng(seed)
    old = np.stack([random.uniform(-1, 1, count), random.uniform(-0.7, 0.7, count), random.uniform(1.5, 3, count)], 1)
    T = inverse(T_OLD_NEW)
    new = old @ T[:3, :3].T + T[:3, 3]
    new *= 1 + random.normal(0, 0.002, (count, 1))
    bad = random.choice(count, round(wrong * count), replace=False)
    new[bad] = new[random.permutation(bad)]
    descriptors = random.integers(0, 256, (count, 32)).astype(np.uint8)
    return Landmarks(descriptors, old.astype(np.float32)), Landmarks(descriptors.copy(), new.astype(np.float32))


@pytest.mark.parametrize("wrong", [0.0, 0.5, 0.75])
def test_pose_in_spite_of_wrong_matches(wrong: float) -> None:
    found = register(*landmarks(wrong), CAMERA, SETTINGS)
    assert len(found.matches) == 120
    assert 0.9 * (1 - wrong) * 120 <= found.count <= (1 - wrong) * 120 + 6
    error = se3_log(found.T_old_new @ inverse(T_OLD_NEW))
    assert np.linalg.norm(error[:3]) < 0.01 and np.linalg.norm(error[3:]) < 0.005


def test_the_same_landmarks_give_the_same_pose() -> None:
    one, two = (register(*landmarks(0.5), CAMERA, SETTINGS) for _ in range(2))
    np.testing.assert_array_equal(one.T_old_new, two.T_old_new)


def test_depth_tells_what_pixels_do_not() -> None:
    """All matches fall where they should, at another depth: no pose."""
    old, new = landmarks(0.0)
    scaled = replace(new, points=new.points * np.random.default_rng(3).uniform(0.5, 2, (120, 1)).astype(np.float32))
    assert register(old, scaled, CAMERA, SETTINGS).count < 12


def test_too_little_gives_no_inliers() -> None:
    old, new = landmarks(0.0)
    few = Landmarks(old.descriptors[:5], old.points[:5])
    none = Landmarks(old.descriptors[:0], old.points[:0])
    inverted = Landmarks(~new.descriptors, new.points)
    for a, b in ((few, new), (none, new), (old, none), (old, Landmarks(inverted.descriptors[:40], new.points[40:80]))):
        found = register(a, b, CAMERA, SETTINGS)
        assert found.count < 12
        assert found.inliers.shape == (len(found.matches),)


def test_landmarks_are_the_features_with_depth() -> None:
    random = np.random.default_rng(0)
    color = np.kron(random.integers(0, 256, (12, 16, 3)), np.ones((20, 20, 1))).astype(np.uint8)
    depth = np.full((240, 320), 2.0, np.float32)
    depth[:, :160] = 0
    view, settings = FeatureView(color, depth, np.eye(4)), FeatureSettings(count=300)
    found, features = view.landmarks(CAMERA, settings), view.features(settings)
    right = np.rint(features.pixels[:, 0]) >= 160
    assert 20 < len(found) == right.sum() < len(features.pixels)
    np.testing.assert_allclose(pixels_of(found.points, CAMERA), features.pixels[right], atol=1e-3)
    np.testing.assert_array_equal(found.points[:, 2], 2.0)
    np.testing.assert_array_equal(found.descriptors, features.descriptors[right])
