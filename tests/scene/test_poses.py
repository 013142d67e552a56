# SPDX-License-Identifier: Apache-2.0
"""Transforms: exponential, logarithm, quaternions and inverses agree with one another and with series."""

from __future__ import annotations

import numpy as np
import pytest

from ggslam.scene.poses import (
    inverse,
    is_valid_pose,
    matrix_to_quaternion,
    orthonormalize,
    quaternion_to_matrix,
    se3_exp,
    se3_log,
    separation,
    so3_log,
    transform_points,
)

ANGLES = (0.0, 1e-12, 1e-8, 9e-7, 1.1e-6, 1e-4, 0.1, 1.0, 3.0, np.pi - 1e-4, np.pi - 1e-7)


def twist(angle: float, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    axis = generator.normal(size=3)
    return np.concatenate([generator.normal(size=3), angle * axis / np.linalg.norm(axis)])


def exponential_series(xi: np.ndarray) -> np.ndarray:
    """Sum of A^k / k! of the 4x4 twist matrix."""
    v, (x, y, z) = xi[:3], xi[3:]
    A = np.zeros((4, 4))
    A[:3, :3], A[:3, 3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]], v
    out, term = np.eye(4), np.eye(4)
    for k in range(1, 40):
        term = term @ A / k
        out = out + term
    return out


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_is_the_series(angle: float) -> None:
    for seed in range(5):
        np.testing.assert_allclose(se3_exp(twist(angle, seed)), exponential_series(twist(angle, seed)), atol=1e-9)


def test_exponential_of_what_is_not_finite() -> None:
    for number in (np.inf, np.nan, 1e200):
        assert np.isnan(se3_exp(np.array([0.1, 0.2, 0.3, number, 0.0, 0.0]))).all()


@pytest.mark.parametrize("angle", ANGLES)
def test_logarithm_undoes_the_exponential(angle: float) -> None:
    for seed in range(5):
        xi = twist(angle, seed)
        # Near pi the sign of the axis hangs on rounding; compare the transforms there.
        np.testing.assert_allclose(se3_exp(se3_log(se3_exp(xi))), se3_exp(xi), atol=1e-9)
        if angle < 3.1:
            np.testing.assert_allclose(se3_log(se3_exp(xi)), xi, atol=1e-9)


def test_logarithm_at_half_a_turn() -> None:
    for axis in np.eye(3):
        R = 2 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(np.abs(so3_log(R)), np.pi * axis, atol=1e-9)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, [1, 2, 3]
        np.testing.assert_allclose(se3_exp(se3_log(T)), T, atol=1e-9)


def test_quaternions_round_trip_in_every_branch() -> None:
    generator = np.random.default_rng(1)
    special = np.vstack([np.eye(4), [[0, 1, 1, 0], [1e-9, 0, 1, 0], [0, 1, 0, 1e-9], [1, 1, 1, 1]]])
    for q in np.vstack([generator.normal(size=(200, 4)), special]):
        found = matrix_to_quaternion(quaternion_to_matrix(q))
        assert abs(found @ q) == pytest.approx(np.linalg.norm(q))
    many = generator.normal(size=(2, 5, 4))
    np.testing.assert_allclose(quaternion_to_matrix(many)[1, 3], quaternion_to_matrix(many[1, 3]))
    quarter_about_z = quaternion_to_matrix(np.array([1.0, 0, 0, 1.0]))  # wxyz: x goes to y
    np.testing.assert_allclose(quarter_about_z @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_inverse_and_orthonormalized() -> None:
    many = np.stack([se3_exp(twist(a, 2)) for a in ANGLES])
    np.testing.assert_allclose(inverse(many) @ many, np.tile(np.eye(4), (len(many), 1, 1)), atol=1e-12)
    worn = many[7] + np.pad(1e-3 * np.random.default_rng(3).normal(size=(3, 3)), ((0, 1), (0, 1)))
    repaired = orthonormalize(worn)
    np.testing.assert_allclose(repaired[:3, :3] @ repaired[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(repaired, many[7], atol=5e-3)


def test_valid_poses() -> None:
    good = se3_exp(twist(1.0))
    assert is_valid_pose(good)
    assert not is_valid_pose(good[:3])
    for row, column, value in ((0, 3, np.nan), (1, 1, np.inf), (0, 0, 5.0)):
        bad = good.copy()
        bad[row, column] = value
        assert not is_valid_pose(bad)
    assert not is_valid_pose(good @ np.diag([1.0, 1, -1, 1]))  # a reflection


def test_separation_is_that_of_the_motion_between() -> None:
    for twist in ([0.3, -0.1, 0.2, 0.4, 0.2, -0.3], [0, 0, 0, 0, 0, 0], [1, 2, 3, 0, 3.0, 0]):
        T_one = se3_exp(np.array([0.5, 1.0, -2.0, 0.3, -0.2, 0.9]))
        T_other = T_one @ se3_exp(np.array(twist, float))
        motion = np.linalg.inv(T_one) @ T_other
        metres, degrees = separation(T_one, T_other)
        assert metres == pytest.approx(np.linalg.norm(motion[:3, 3]), abs=1e-12)
        assert degrees == pytest.approx(np.degrees(np.linalg.norm(twist[3:])), abs=1e-6)


def test_transformed_points() -> None:
    T, points = se3_exp(np.array([0.5, 1.0, -2.0, 0.3, -0.2, 0.9])), np.random.default_rng(0).normal(size=(7, 3))
    expected = (T @ np.column_stack([points, np.ones(7)]).T).T[:, :3]
    np.testing.assert_allclose(transform_points(points, T), expected, atol=1e-12)
