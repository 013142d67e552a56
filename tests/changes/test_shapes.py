# SPDX-License-Identifier: Apache-2.0
"""Surfaces of thin things: their two faces are not taken for one another."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.changes.shapes import Shape, _Target

THICK_M = 0.02


def face(z: float, side: float, until: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] of a face of a board, 5 mm apart, up to a width, and the directions to a camera on its side."""
    x, y = np.meshgrid(np.arange(0, until, 0.005), np.arange(0, 0.1, 0.005))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], 1)
    toward = np.array([0.3, 0.2, side]) - points
    return points, toward / np.linalg.norm(toward, axis=1, keepdims=True)


def board(*faces: tuple[np.ndarray, np.ndarray]) -> Shape:
    points, toward = (np.concatenate(parts) for parts in zip(*faces, strict=True))
    return Shape.from_views(points, np.full(points.shape, 0.5, np.float32), toward)


def test_normals_point_to_where_each_face_was_seen_from() -> None:
    both = board(face(THICK_M / 2, 1.0), face(-THICK_M / 2, -1.0))
    up = both.points[:, 2] > 0
    assert np.allclose(both.normals[up], [0, 0, 1]) and np.allclose(both.normals[~up], [0, 0, -1])
    over = np.diag([1.0, -1.0, -1.0, 1.0])
    assert np.allclose(both.move(over).normals, -both.normals)
    assert np.allclose(both.move(over).points[:, 2], -both.points[:, 2])


@pytest.mark.parametrize("faces", [True, False])
def test_a_board_that_was_seen_from_the_other_side_stays_as_thick_as_it_is(faces: bool) -> None:
    before = board(face(THICK_M / 2, 1.0))
    after = board(face(-THICK_M / 2, -1.0), face(THICK_M / 2, 1.0, until=0.05))
    start = np.eye(4)
    start[2, 3] = -0.015
    T = _Target(after, faces).refine(before, start, 0.012, np.eye(6)[:, 2:3])
    assert T[2, 3] == pytest.approx(0 if faces else -THICK_M, abs=0.003)


def test_a_shape_without_points_has_none() -> None:
    assert Shape.from_views(*(np.zeros((0, 3)) for _ in range(3))).normals.shape == (0, 3)
