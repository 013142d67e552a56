# SPDX-License-Identifier: Apache-2.0
"""True labels of Gaussians: by votes of the masks that see them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ggslam.evaluation.gaussian_labels import GaussianTruth, LabelTuning
from ggslam.evaluation.segmentation import Matching
from ggslam.scene.camera import Camera
from ggslam.system.tuning import overridden

CAMERA = Camera(8, 6, 8.0, 8.0, 3.5, 2.5)
IDENTITY = np.eye(4)


def at(column: float, row: float, depth: float) -> list[float]:
    """The point at a depth behind a pixel."""
    return [(column - CAMERA.cx) / CAMERA.fx * depth, (row - CAMERA.cy) / CAMERA.fy * depth, depth]


def halves() -> np.ndarray:
    """Id 1 left, id 2 right."""
    return np.repeat(np.array([[1] * 4 + [2] * 4], np.uint16), 6, 0)


def truth_of(points: list[list[float]], depth: float = 2.0, mask: np.ndarray | None = None) -> np.ndarray:
    truth = GaussianTruth(len(points))
    depths = np.full((6, 8), depth, np.float32)
    truth.add(CAMERA, IDENTITY, depths, halves() if mask is None else mask, *numbered(points))
    return truth.labels()


def numbered(points: list[list[float]]) -> tuple[np.ndarray, np.ndarray]:
    """All of the points, and their numbers."""
    return np.array(points, np.float32), np.arange(len(points))


def test_only_what_is_seen_gets_a_label() -> None:
    points = [at(1, 2, 2), at(6, 2, 2), at(1, 2, 2.03), at(1, 2, 2.05), at(1, 2, 1.9), at(1, 2, -2), at(-0.6, 2, 2)]
    # Within 2 % (4 cm at 2 m) of the depth; hidden; floating before the surface; behind the camera; beside the image.
    assert truth_of(points).tolist() == [1, 2, 1, 0, 0, 0, 0]
    assert truth_of([at(7.4, 5.4, 2), at(-0.4, -0.4, 2)]).tolist() == [2, 1]  # nearest pixel, to the very border
    assert truth_of([at(1, 2, 2)], depth=0).tolist() == [0]  # nothing was measured
    assert truth_of([at(1, 2, 2)], mask=np.zeros((6, 8), np.uint16)).tolist() == [0]


def test_the_nearer_tolerance_is_two_centimetres() -> None:
    assert truth_of([at(1, 2, 0.518), at(1, 2, 0.522)], depth=0.5).tolist() == [1, 0]


def test_the_majority_of_views_counts() -> None:
    with overridden(LabelTuning, keys_at_once=3):
        truth, points = GaussianTruth(2), numbered([at(1, 2, 2), at(6, 2, 2)])
        depth, one, other = np.full((6, 8), 2, np.float32), halves(), np.full((6, 8), 7, np.uint16)
        for mask in (one, other, other, one, other):
            truth.add(CAMERA, IDENTITY, depth, mask, *points)
        assert truth.labels().tolist() == [7, 7]
        truth.add(CAMERA, IDENTITY, depth, one, *points)
        assert truth.labels().tolist() == [1, 2]  # three each: the lower id


def test_the_pose_is_from_world_to_camera() -> None:
    T = np.eye(4)
    T[0, 3] = 1.0  # the camera stands a metre to the left of the origin
    truth = GaussianTruth(1)
    means = np.array([at(6, 2, 2)], np.float32) - np.array([1, 0, 0], np.float32)
    truth.add(CAMERA, T, np.full((6, 8), 2, np.float32), halves(), means, np.arange(1))
    assert truth.labels().tolist() == [2]


def test_views_of_parts_of_a_map() -> None:
    truth, depth = GaussianTruth(5), np.full((6, 8), 2, np.float32)
    truth.add(CAMERA, IDENTITY, depth, halves(), np.array([at(1, 2, 2), at(6, 2, 2)], np.float32), np.array([3, 1]))
    truth.add(CAMERA, IDENTITY, depth, halves(), np.array([at(6, 3, 2)], np.float32), np.array([4]))
    assert truth.labels().tolist() == [0, 2, 0, 1, 2]


def test_accuracy_by_hand() -> None:
    truth, points = GaussianTruth(4), numbered([at(1, 2, 2), at(2, 2, 2), at(6, 2, 2), at(6, 2, 5)])
    truth.add(CAMERA, IDENTITY, np.full((6, 8), 2, np.float32), halves(), *points)
    labels, opacities = np.array([5, 0, 6, 6]), np.array([0.5, 0.25, 0.25, 1.0])
    s = truth.scores(labels, opacities, Matching("assignment", {1: 5}))
    assert (s.labelled, s.gaussians) == (3, 4)
    assert s.accuracy == pytest.approx(1 / 3) and s.accuracy_by_opacity == pytest.approx(0.5)
    s = truth.scores(labels, opacities, Matching("assignment", {1: 5, 2: 6}))
    assert s.accuracy == pytest.approx(2 / 3) and s.accuracy_by_opacity == pytest.approx(0.75)


def test_nothing_labelled_and_wrong_sizes() -> None:
    truth = GaussianTruth(2)
    assert math.isnan(truth.scores(np.zeros(2, int), np.ones(2), Matching("same", {})).accuracy)
    with pytest.raises(ValueError, match="depth"):
        truth.add(CAMERA, IDENTITY, np.zeros((8, 6), np.float32), halves(), *numbered([[0, 0, 1]] * 2))
