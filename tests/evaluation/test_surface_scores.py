# SPDX-License-Identifier: Apache-2.0
"""Distances of points from a surface are those that they were given."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.evaluation.surface import score_surface

SPACING = 0.01


def plane(extent: float = 1.0) -> np.ndarray:
    line = np.arange(0, extent, SPACING)
    return np.stack([*(axis.ravel() for axis in np.meshgrid(line, line)), np.zeros(len(line) ** 2)], 1)


def test_points_between_the_samples_are_as_far_as_the_surface_is() -> None:
    surface = plane()
    normals = np.tile([0.0, 0.0, 1.0], (len(surface), 1))
    points = surface + [SPACING / 2, SPACING / 2, 0.003]
    inside = (points[:, :2] < 1 - SPACING).all(1)
    scores = score_surface(points[inside], surface, normals, SPACING)
    assert scores.median_m == pytest.approx(0.003, abs=1e-9) and scores.p95_m == pytest.approx(0.003, abs=1e-9)
    assert scores.thresholds[0].precision == 1 and scores.points == inside.sum()


def test_points_beyond_the_border_are_as_far_as_the_border_is() -> None:
    surface = plane()
    normals = np.tile([0.0, 0.0, 1.0], (len(surface), 1))
    scores = score_surface(np.array([[-0.05, 0.5, 0.0]]), surface, normals, SPACING)
    assert scores.median_m == pytest.approx(0.05)


def test_shares_are_those_of_what_lies_off_and_of_what_is_missing() -> None:
    surface = plane()
    normals = np.tile([0.0, 0.0, 1.0], (len(surface), 1))
    points = surface[surface[:, 0] < 0.5].copy()
    points[: len(points) // 4, 2] = 0.015  # a quarter is off by more than 1 cm, and by less than 2
    near, far = score_surface(points, surface, normals, SPACING).thresholds
    assert near.precision == pytest.approx(0.75, abs=0.01) and far.precision == 1
    assert far.recall == pytest.approx(0.51, abs=0.01)  # half, and what lies within 2 cm of it
