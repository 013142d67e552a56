# SPDX-License-Identifier: Apache-2.0
"""Which Gaussians belong to an object, in maps of a few point clouds."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ggslam.errors import ConfigError
from ggslam.objects.membership import MembershipSettings, in_hull, members
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IDENTITY_CHANNELS, IdentityClassifier

WALL, CUP = 1, 2
CLASSIFIER = IdentityClassifier(
    np.array([WALL, CUP], np.uint16), 8 * np.eye(2, IDENTITY_CHANNELS, dtype=np.float32), np.zeros(2, np.float32)
)
WITHOUT_FLOATERS = MembershipSettings(floaters=False)


def map_of(*parts: tuple[np.ndarray, int, int]) -> GaussianMap:
    """A map of parts (points [M, 3], stored label, object that the identity vectors tell; 0: of none)."""
    gaussians = GaussianMap(feature_channels=IDENTITY_CHANNELS, with_moments=False)
    for points, label, told in parts:
        features = np.zeros((len(points), IDENTITY_CHANNELS), np.float32)
        if told:
            features[:, told - 1] = 1
        count = len(points)
        gaussians.insert(
            torch.from_numpy(points.astype(np.float32)), torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            torch.full((count, 3), -4.0), torch.zeros(count), torch.zeros(count, 3), torch.from_numpy(features),
            object_id=torch.full((count,), label, dtype=torch.int32),
        )  # fmt: skip
    return gaussians


def wall() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], 1)


def shell(radius: float = 0.1) -> np.ndarray:
    """Points on a sphere around (0, 0, 1)."""
    points = np.random.default_rng(0).normal(size=(400, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True) + [0, 0, 1]


def test_a_wrong_label_in_the_surface_of_another_object_is_given_back() -> None:
    gaussians = map_of((wall(), WALL, WALL), (shell(), CUP, CUP), (np.array([[0.51, 0.52, 2.0]]), CUP, CUP))
    chosen = members(gaussians, CLASSIFIER, [CUP])
    assert chosen[1681:2081].all() and not chosen[:1681].any() and not chosen[2081]
    assert members(gaussians, CLASSIFIER, [CUP], MembershipSettings(repair=False))[2081]


def test_floaters_are_removed_with_an_object_but_do_not_move_with_it() -> None:
    gaussians = map_of((wall(), WALL, WALL), (shell(), CUP, CUP), (np.array([[0.6, 0, 0.7], [0.61, 0, 0.7]]), CUP, CUP))
    assert members(gaussians, CLASSIFIER, [CUP])[-2:].all()
    chosen = members(gaussians, CLASSIFIER, [CUP], WITHOUT_FLOATERS)
    assert chosen[1681:2081].all() and not chosen[-2:].any()


def test_what_is_unlabelled_inside_an_object_is_taken_along_and_what_is_another_s_is_not() -> None:
    unlabelled = np.array([[0, 0, 1.06], [0.02, 0, 1.07]])
    gaussians = map_of((wall(), WALL, WALL), (shell(), CUP, CUP), (unlabelled, 0, 0), (shell(0.02)[:40], WALL, WALL))
    assert members(gaussians, CLASSIFIER, [CUP])[1681:].tolist() == 402 * [True] + 40 * [False]


def test_the_hull_of_a_wall_does_not_claim_the_room() -> None:
    corner = np.concatenate([wall(), wall()[:, [2, 1, 0]] - [1, 0, -1]])  # two walls at a right angle
    gaussians = map_of((corner, WALL, WALL), (shell(0.3), CUP, CUP))
    assert not members(gaussians, CLASSIFIER, [WALL])[len(corner) :].any()


def test_probability_claims_what_has_no_label_and_labels_count_without_a_classifier() -> None:
    gaussians = map_of((wall(), WALL, WALL), (shell(), 0, CUP))
    assert members(gaussians, CLASSIFIER, [CUP]).sum() == 400
    nobody = IdentityClassifier.empty()
    assert not members(gaussians, nobody, [CUP]).any()
    assert members(gaussians, nobody, [WALL])[:1681].all()


def test_an_empty_map_has_no_members() -> None:
    assert members(map_of(), CLASSIFIER, [CUP]).shape == (0,)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match="threshold"):
        MembershipSettings(threshold=1.5)
    with pytest.raises(ConfigError, match="link_spacings"):
        MembershipSettings(link_spacings=float("nan"))


def test_flat_sets_have_a_hull() -> None:
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
    assert in_hull(flat, np.array([[0.5, 0.5, 0], [0.5, 0.5, 0.2], [2, 0, 0]])).tolist() == [True, False, False]


def test_a_wall_takes_nothing_of_what_stands_before_it() -> None:
    """Of a cupboard's front 22 cm before a wall some Gaussians look like the wall to the classifier, some have none;
    so has a speck of the wall that looks like the cupboard."""
    rng = np.random.default_rng(1)
    front = wall()[rng.permutation(1681)] * [0.4, 0.4, 1] - [0, 0, 0.22]
    speck = np.array([[0.51, 0.52, 2.0]])
    parts = ((wall(), WALL, WALL), (front[:1200], CUP, CUP), (front[1200:1400], CUP, WALL), (front[1400:], 0, 0),
             (speck, CUP, WALL))  # fmt: skip
    chosen = members(map_of(*parts), CLASSIFIER, [WALL])
    assert chosen[:1681].all() and chosen[-1]
    assert not chosen[1681:-1].any()
    alone = members(map_of(*parts), CLASSIFIER, [CUP])
    assert alone[1681:3081].all() and alone[3081:-1].mean() > 0.95 and not alone[:1681].any()


def test_the_hull_of_a_bent_wall_takes_nothing_that_lies_on_another_object() -> None:
    side = wall()[:, [2, 1, 0]] - [1, 0, -1]
    corner = np.concatenate([wall(), side])
    board = np.array([[x, y, 1.78] for x in np.linspace(-0.3, 0.6, 16) for y in np.linspace(-0.5, 0.5, 16)])
    gaussians = map_of((corner, WALL, WALL), (board[::2], CUP, CUP), (board[1::2], 0, 0))
    assert not members(gaussians, CLASSIFIER, [WALL])[len(corner) :].any()
