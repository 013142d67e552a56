# SPDX-License-Identifier: Apache-2.0
"""Trajectory errors follow their definitions, and alignment removes exactly what it may."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ggslam.evaluation.trajectory import align_points, score_trajectory
from ggslam.scene.poses import inverse, se3_exp, se3_log


def walk(count: int = 60, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    poses = [se3_exp(generator.normal(size=6))]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3_exp(generator.normal(size=6) * 0.05))
    return np.stack(poses)


def test_a_moved_trajectory_is_perfect() -> None:
    truth = walk()
    scores = score_trajectory(se3_exp(np.array([3, -2, 1, 0.5, 1.0, -2.0])) @ truth, truth)
    assert scores is not None and scores.frames_compared == 60
    assert max(scores.ate_rmse_m, scores.ate_max_m, scores.ate_raw_rmse_m, scores.rpe_trans_m) < 1e-12
    assert scores.rpe_rot_deg < 1e-9


@pytest.mark.parametrize("with_scale", [False, True])
def test_alignment_recovers_the_transform(with_scale: bool) -> None:
    points = np.random.default_rng(1).normal(size=(20, 3))
    T, scale = se3_exp(np.array([1, 2, 3, 0.3, -2.0, 1.0])), 1.7 if with_scale else 1.0
    found, found_scale = align_points(points, scale * points @ T[:3, :3].T + T[:3, 3], with_scale)
    np.testing.assert_allclose(found, T, atol=1e-12)
    assert found_scale == pytest.approx(scale)


def test_alignment_is_a_rotation_even_where_a_reflection_would_fit_better() -> None:
    points = np.random.default_rng(2).normal(size=(20, 3))
    found, _ = align_points(points, points * [1, 1, -1])
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)


def test_alignment_is_the_minimum() -> None:
    generator = np.random.default_rng(3)
    source, target = generator.normal(size=(2, 30, 3))
    best, _ = align_points(source, target)

    def error(T: np.ndarray) -> float:
        return float(((source @ T[:3, :3].T + T[:3, 3] - target) ** 2).sum())

    for _ in range(50):
        assert error(se3_exp(generator.normal(size=6) * 0.01) @ best) > error(best)


def test_straight_and_standing_trajectories() -> None:
    line = np.tile(np.eye(4), (10, 1, 1))
    line[:, 0, 3] = np.arange(10)
    scores = score_trajectory(se3_exp(np.array([0, 0, 0, 0.3, 0.2, 0.1])) @ line, line)
    assert scores is not None and scores.ate_rmse_m < 1e-12
    still = np.tile(np.eye(4), (10, 1, 1))
    scores = score_trajectory(still, still)
    assert scores is not None and scores.ate_rmse_m == 0


def test_each_number_by_hand() -> None:
    """Truth stands still at the corners of a square; one estimated corner is off by 0.4 m upwards."""
    truth = np.tile(np.eye(4), (4, 1, 1))
    truth[:, :2, 3] = [[0, 0], [1, 0], [1, 1], [0, 1]]
    estimated = truth.copy()
    estimated[2, 2, 3] += 0.4
    scores = score_trajectory(estimated, truth)
    assert scores is not None
    assert scores.ate_raw_rmse_m == pytest.approx(np.sqrt(0.4**2 / 4))
    assert scores.rpe_trans_m == pytest.approx(np.sqrt((0 + 0.4**2 + 0.4**2) / 3))
    assert scores.rpe_rot_deg == 0
    assert scores.ate_rmse_m < scores.ate_raw_rmse_m and scores.ate_mean_m <= scores.ate_rmse_m <= scores.ate_max_m
    turned = truth.copy()
    turned[3] = turned[3] @ se3_exp(np.array([0, 0, 0, 0, 0, np.deg2rad(10)]))
    scores = score_trajectory(turned, truth)
    assert scores is not None and scores.rpe_rot_deg == pytest.approx(np.sqrt(100 / 3))


def test_relative_errors_against_the_definition() -> None:
    truth, estimated = walk(), walk()
    estimated[30:] = se3_exp(np.array([0.1, 0, 0.05, 0.02, 0.01, 0])) @ estimated[30:]
    for delta in (1, 7):
        motions = [
            se3_log(
                inverse(inverse(truth[i]) @ truth[i + delta]) @ inverse(estimated[i]) @ estimated[i + delta]
            )
            for i in range(60 - delta)
        ]  # fmt: skip
        angles = [np.linalg.norm(m[3:]) for m in motions]
        scores = score_trajectory(estimated, truth, rpe_delta=delta)
        assert scores is not None and scores.rpe_delta == delta
        assert scores.rpe_rot_deg == pytest.approx(np.rad2deg(np.sqrt(np.mean(np.square(angles)))))


def test_unknown_poses_are_left_out() -> None:
    truth, estimated = walk(), list(walk())
    truth[5] = np.nan
    truth[0, 1, 3] = -np.inf
    estimated[9] = None
    estimated[10][:3, 3] += 1e-3
    scores = score_trajectory(estimated, truth)
    assert scores is not None and scores.frames_compared == 57
    # Of frame 10 only the motion to 11 is left, since 9 is unknown; known pairs: 59 - {0-1, 4-5, 5-6, 8-9, 9-10}.
    assert scores.rpe_trans_m == pytest.approx(np.sqrt(3) * 1e-3 / np.sqrt(54))


def test_too_few_poses_give_no_scores() -> None:
    truth = walk(10)
    estimated = [None] * 8 + list(truth[8:])
    assert score_trajectory(estimated, truth) is None
    assert score_trajectory([], []) is None
    short = score_trajectory(truth[:3], truth[:3], rpe_delta=5)
    assert short is not None and json.loads(json.dumps(short.to_dict(), allow_nan=False))["rpe_trans_m"] is None
    with pytest.raises(ValueError, match="10 .*9 "):
        score_trajectory(truth, truth[:9])
