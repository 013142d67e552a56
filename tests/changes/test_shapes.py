# SPDX-License-Identifier: Apache-2.0
"""Surfaces of thin things: their two faces are not taken for one another."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ggslam.changes.alignment_score import Fit
from ggslam.changes.motions import likeliest_motions
from ggslam.changes.settings import ChangeSettings
from ggslam.changes.shape import Shape, Target
from ggslam.changes.shape_alignment import _stay_level
from ggslam.scene.poses import transform_points

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
    T = Target(after, faces).refine(before, start, 0.012, np.eye(6)[:, 2:3])
    assert T[2, 3] == pytest.approx(0 if faces else -THICK_M, abs=0.003)


def test_a_shape_without_points_has_none() -> None:
    assert Shape.from_views(*(np.zeros((0, 3)) for _ in range(3))).normals.shape == (0, 3)


UP = np.array([0.0, 0.0, 1.0])


def basket(low: float, high: float, at: float) -> Shape:
    """The wall of a round basket between two heights, seen from all around."""
    turn, height = (a.ravel() for a in np.meshgrid(np.arange(0, 2 * np.pi, 0.05), np.arange(low, high, 0.006)))
    out = np.stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))], 1)
    points = 0.12 * out + np.stack([np.full(len(turn), at), np.zeros(len(turn)), height], 1)
    return Shape.from_views(points, np.full((len(turn), 3), 0.5, np.float32), out.astype(np.float32))


@pytest.mark.parametrize("rise, costs, level", [
    (0.06, 0.09, True), (-0.06, 0.09, True),
    (0.06, 0.11, False),  # too little fits for it to be the same thing
    (0.06, 0.2, False),  # it stands on a book now
    (0.4, 0.1, False),  # from the floor onto a table
    (0.005, 0.1, False),  # nothing to speak of
])  # fmt: skip
def test_a_thing_that_seems_to_rise_a_little_stays_at_its_height(rise: float, costs: float, level: bool) -> None:
    """The visits saw the lower and the upper part of a wall, which slide upon each other; `costs`: how much worse the
    fit is if it stays at its height."""
    old, new = basket(0.0, 0.2, 0.0), basket(0.1, 0.3, 0.5)
    found = np.eye(4)
    found[:3, 3] = 0.508, 0.0, rise

    def fit(T: np.ndarray) -> Fit:
        return Fit(T, share=0.9 if abs(T[2, 3] - rise) < 1e-6 else 0.9 - costs, seen=1.0, color_apart=0.0)

    judge = SimpleNamespace(fit=fit, settings=ChangeSettings())
    kept = _stay_level(fit(found), judge, (Target(new), Target(new, faces=True)), old, UP)  # type: ignore[arg-type]
    assert np.allclose(kept.T_new_old[:3, 3], [0.5, 0, 0] if level else found[:3, 3], atol=0.002)


def banded(low: float, high: float, at: float) -> Shape:
    """A basket in bands of colours that do not repeat."""
    shape = basket(low, high, at)
    shades = np.random.default_rng(4).random((20, 3)).astype(np.float32)
    return Shape(shape.points, shades[(shape.points[:, 2] / 0.05).astype(int)], shape.normals)


def test_a_thing_of_which_one_visit_saw_the_lower_part_is_looked_for_at_its_height() -> None:
    """The middles of what was seen lie 20 cm above each other."""
    motions = likeliest_motions(banded(0.0, 0.2, 0.0), banded(0.0, 0.6, 0.5), UP)
    upright = [T for T in motions if T[2, 2] > 0.99]
    assert min(np.linalg.norm(transform_points(np.zeros((1, 3)), T)[0] - [0.5, 0, 0]) for T in upright) < 0.02
